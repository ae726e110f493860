"""Times of images in files, ``times.txt`` and lists, and pairing two streams by time."""

import bisect
import math
import re
from pathlib import Path

from ...checks import shown
from ...errors import SequenceError
from ...files import is_file
from .poses import image_key, read_lines, read_words
from .stamps import PER_SECOND, date_unit, median_step, time_unit

TIMES = "times.txt"


def associate(
    first_s: list[float], second_s: list[float], *, max_difference_s: float = 0.02
) -> list[tuple[int, int]]:
    """Pairs (i, j) of the entries of two streams that are nearest in time, each entry used at most
    once.

    Candidates are taken in order of their time difference, so a worse pair never uses an entry of a
    better one (Sturm et al. 2012, the association of the TUM RGB-D benchmark).

    Args:
        first_s: Times of the first stream, seconds, any order.
        second_s: Times of the second stream, seconds, any order.
        max_difference_s: Largest difference of a pair, seconds.

    Returns:
        Pairs of positions, ordered by the time of the first stream.
    """
    order = sorted(range(len(second_s)), key=second_s.__getitem__)
    times = [second_s[j] for j in order]
    candidates = []
    for i, t in enumerate(first_s):
        # wider, so that rounding excludes no candidate
        k = bisect.bisect_left(times, t - 2 * max_difference_s)
        while k < len(times) and times[k] <= t + 2 * max_difference_s:
            if abs(times[k] - t) <= max_difference_s:
                candidates.append((abs(times[k] - t), i, order[k]))
            k += 1
    pairs: dict[int, int] = {}
    used: set[int] = set()
    for _, i, j in sorted(candidates):
        if i not in pairs and j not in used:
            pairs[i] = j
            used.add(j)
    return sorted(pairs.items(), key=lambda pair: first_s[pair[0]])


_LISTED = r"""([-+]?[\d.]+(?:[eE][-+]?\d+)?)[\s,]+("[^"]+"|'[^']+'|\S.*?)"""
"""A number, and the name of a file, which may stand in quotes or hold spaces."""


def read_image_list(
    path: Path,
    *,
    per_line: int = 1,
) -> list[list[tuple[float, Path]]]:
    """Number and file of each image of a list, which may have several images in a line: "timestamp
    filename".

    The numbers are finite, but not yet judged to be times. A name may hold spaces or stand in
    quotes, and its folders may be separated by backslashes, as Windows writes them.

    Args:
        path: The list; names are relative to its folder.
        per_line: Number of images in a line, 2 for associations.

    Raises:
        SequenceError: another line; names the file and the line.
    """
    what = " ".join(["timestamp filename"] * per_line)
    pattern = re.compile(r"[\s,]+".join([_LISTED] * per_line))
    rows = []
    for line_number, line in read_lines(path, f"lines '{what}'"):
        match = pattern.fullmatch(line)
        groups = () if match is None else match.groups()
        numbers = [_finite(text) for text in groups[::2]]
        if not numbers or None in numbers:
            raise SequenceError(f"{path} line {line_number} must be '{what}', got {shown(line)}")
        files = [_listed_file(path.parent, name) for name in groups[1::2]]
        rows.append(list(zip(numbers, files, strict=True)))
    return rows


def _finite(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _listed_file(folder: Path, name: str) -> Path:
    """The file that a list names; of several ways to read the name the first that is there."""
    name = name.strip().strip("\"'")
    ways = (name, name.replace("\\", "/"), name.split()[0].replace("\\", "/"))
    return next(
        (folder / way for way in ways if is_file(folder / way)),
        folder / ways[1],
    )


def times_of_images(
    path: Path,
    images: list[Path],
) -> tuple[list[tuple[float, float]] | None, str]:
    """Seconds of each image and of its depth, by its name, from lines "name seconds" or "name
    seconds depth_seconds".

    Returns:
        The times, or ``None`` and the reason why there are none.

    Raises:
        SequenceError: a line that is not a name and one or two numbers, or an image that is not in
            the file.
    """
    if not path.is_file():
        return None, f"there is no {path.name}"
    time_of: dict[str, tuple[float, float]] = {}
    for number, words in read_words(path, "lines 'name seconds'"):
        if words[:2] == ["frame", "time_s"]:
            continue
        try:
            name, value, *of_depth = words
            (depth_value,) = of_depth or [value]
            time_of[image_key(name)] = float(value), float(depth_value)
        except ValueError:
            raise SequenceError(
                f"{path} line {number} must be 'name seconds', got {shown(' '.join(words))}"
            ) from None
    lacking = [image for image in images if image_key(image.stem) not in time_of]
    if lacking:
        raise SequenceError(f"{path} has no time of {lacking[0]}; expected one per image")
    times = [time_of[image_key(image.stem)] for image in images]
    if not all(math.isfinite(t) for pair in times for t in pair):
        return None, f"{path.name} holds none"  # converted from a recording without times
    _check_seconds([t for t, _ in times], path)
    return times, ""


LONGEST_STEP_S = 60.0
"""Frames of a recording are nearer to each other in the median."""


def _check_seconds(times: list[float], path: Path) -> None:
    """Raise ``SequenceError`` for times that are not seconds; the message names the unit that they
    have."""
    in_order = sorted(times)
    unit = time_unit(in_order)
    step = median_step(in_order)
    if unit == "s" or (not date_unit(in_order[-1]) and step <= LONGEST_STEP_S):
        return
    raise SequenceError(
        f"{path} must hold seconds, but as seconds there would be one frame in {step:g} s; as "
        f"{unit} it is one in "
        f"{step / PER_SECOND[unit]:.3g} s: divide the times by {PER_SECOND[unit]:g}"
    )
