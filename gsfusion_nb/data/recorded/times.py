"""Times of images: whether numbers are times and in which unit, ``times.txt``, and pairing two
streams by time."""

import bisect
import itertools
import logging
import math
import re
import statistics
from collections import abc
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...checks import shown
from ...errors import SequenceError
from ...files import is_file
from .poses import image_key, read_lines, read_words

log = logging.getLogger(__name__)

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


USUAL_STEPS_S = (1 / 130, 1.0)
"""People film with 1 to 120 frames a second; 130, since whole milliseconds are rounded."""

_UNITS_S = {"ms": 1e-3, "us": 1e-6, "minutes": 60.0, "hours": 3600.0}
"""Units in which somebody may have written times, in seconds."""


@dataclass(frozen=True)
class DoubtfulTimes:
    """Why the times of frames may not be seconds."""

    sentence: str
    remedy: str
    """What to do if they are not."""


def doubt_on_times(
    times_s: abc.Sequence[float], *, if_counted: str, name: str
) -> DoubtfulTimes | None:
    """A doubt on times that are taken as seconds; None where nothing speaks against them.

    A date is never doubted, since its size fixes its unit.

    Args:
        times_s: Of all frames, in any order.
        if_counted: What to do if they number the frames.
        name: Of the file that holds them.
    """
    in_order = sorted(times_s)
    step = _median_step(in_order)
    if step <= 0 or date_unit(in_order[-1]):
        return None
    least, most = USUAL_STEPS_S
    beginning = f"as seconds they would be one frame in {step:.3g} s"
    if step >= most and _counter(in_order, is_padded=False):
        return DoubtfulTimes(
            f"{beginning}, but they are whole numbers, as those are that count frames, from "
            f"{in_order[0]:g} to {in_order[-1]:g}",
            f"if they number the frames: {if_counted}",
        )
    if least <= step <= most:
        return None
    sentence = f"{beginning}, but what people film has 1 to 120 frames a second"
    unit = next(
        (unit for unit, unit_s in _UNITS_S.items() if least <= step * unit_s <= most),
        "",
    )
    if not unit:
        return DoubtfulTimes(sentence, f"write seconds into {name}, or, without: {if_counted}")
    unit_s = _UNITS_S[unit]
    change = f"multiply them by {unit_s:g}" if unit_s > 1 else f"divide them by {1 / unit_s:g}"
    return DoubtfulTimes(
        f"{sentence}; in {unit} it would be one in {step * unit_s:.3g} s",
        f"if {name} holds {unit}: {change}",
    )


def warn_of_doubt(
    file: Path, times_s: abc.Sequence[float], *, if_counted: str
) -> DoubtfulTimes | None:
    """``doubt_on_times`` on those of ``file``, which a warning names."""
    doubt = doubt_on_times(times_s, if_counted=if_counted, name=file.name)
    if doubt is not None:
        log.warning("%s: %s; %s", file, doubt.sentence, doubt.remedy)
    return doubt


def _check_seconds(times: list[float], path: Path) -> None:
    """Raise ``SequenceError`` for times that are not seconds; the message names the unit that they
    have."""
    in_order = sorted(times)
    unit = time_unit(in_order)
    step = _median_step(in_order)
    if unit == "s" or (not date_unit(in_order[-1]) and step <= LONGEST_STEP_S):
        return
    raise SequenceError(
        f"{path} must hold seconds, but as seconds there would be one frame in {step:g} s; as "
        f"{unit} it is one in "
        f"{step / PER_SECOND[unit]:.3g} s: divide the times by {PER_SECOND[unit]:g}"
    )


PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "100ns": 1e7, "ns": 1e9}
"""Units of times; "100ns" are the ticks of Windows and .NET."""
LARGEST_STEP = {"s": 5.0, "ms": 5e3, "us": 5e5, "ns": float("inf")}
"""A median step above this belongs to the next finer unit: 5 s, 5 s, and 0.5 s, since 5e5 ns are 2
kHz. Ticks are known by their dates alone."""
DATES = (
    ("s", 1e9, 1e10),
    ("ms", 1e12, 1e13),
    ("us", 1e15, 1e16),
    ("ns", 1e18, 1e19),
    ("100ns", 1.26e17, 1.6e17),
    ("100ns", 6.3e17, 6.7e17),
)
"""Unit, first and last of numbers that are dates: from 2001 to 2286 since 1970, or, in ticks, from
2000 to 2107 since 1601 (Windows), and from 1997 to 2124 since the year 1 (.NET)."""
MOST_PER_SECOND = 1000.0
"""No depth camera takes more frames per second: numbers that are nearer to each other are not
times."""
_REPEATED = 0.1
"""Share of equal neighbours above which numbers are not times."""
_COUNTER_BELOW = 1e6
_COUNTER_STEP = 20
"""Whole numbers below the first with a constant step below the second count frames; a clock has
larger numbers, and in milliseconds larger steps."""
_LEAST_STEP_MS = 15.0
"""Whole numbers of a clock in milliseconds have a larger median step: no more than 66 frames a
second."""


@dataclass(frozen=True)
class Stamps:
    """What was decided on a list of numbers."""

    times_s: list[float] | None
    """Seconds, in the order of the numbers; None: they are not times."""
    why_not: str = ""
    """Why they are not times."""
    unit: str = "s"
    unordered: int = 0
    """Numbers that are smaller than the one before, in a list that must be sorted by time."""
    is_guess: bool = False
    """They are whole and small enough to number frames, too."""
    counts_frames: bool = False
    """They are no times, but those of a counter."""


def judge_stamps(
    numbers: abc.Sequence[float],
    *,
    names: abc.Sequence[Any] = (),
    unit: str = "auto",
    common: str = "",
    padded: bool = False,
) -> Stamps:
    """Are these numbers the times at which images were taken?

    Durations of the frames, frame counters, equal or negative numbers are not. Numbers that do not
    increase in the order given are times only if the names of the images say the same order.

    Args:
        numbers: Finite numbers, in the order of the list or file.
        names: Sorting keys of the images' names; empty where nothing but the numbers tells an
            order.
        unit: One of ``PER_SECOND`` where the file's format or the user fixes it; "none": they are
            not times; "auto" finds it by the numbers.
        common: For "auto", the unit of all lists of the recording, ``common_unit``.
        padded: They are written with leading zeros, as counters are.
    """
    values = list(numbers)
    in_order = sorted(numbers)
    if not values:
        return Stamps([])
    if unit == "none":
        return Stamps(None, "the user says so")
    best_unit = unit
    if unit == "auto":
        best_unit = common or time_unit(in_order)
    counter = _counter(in_order, is_padded=padded) if unit == "auto" else ""
    reason = _no_times(in_order, PER_SECOND[best_unit]) or counter
    times = [v / PER_SECOND[best_unit] for v in values]
    guess = unit == "auto" and _may_count(in_order)
    n_backward = sum(b < a for a, b in itertools.pairwise(values))
    if n_backward and not reason:
        by_time = sorted(range(len(values)), key=values.__getitem__)
        if names and [names[i] for i in by_time] == sorted(names):
            return Stamps(times, unit=best_unit, unordered=n_backward, is_guess=guess)
        reason = f"{n_backward} of {len(values)} are smaller than the one before"
    if reason:
        return Stamps(None, reason, best_unit, counts_frames=bool(counter))
    return Stamps(times, unit=best_unit, is_guess=guess)


def date_unit(value: float) -> str:
    """The unit in which a number is a date of today; empty if it is none."""
    return next(
        (unit for unit, first, last in DATES if first <= abs(value) < last),
        "",
    )


def time_unit(increasing: abc.Sequence[float]) -> str:
    """Unit in which times are dates of today (``DATES``), or in which the median step is that of a
    camera."""
    return date_unit(increasing[-1]) or _unit_of_step(_median_step(increasing))


def common_unit(lists: abc.Iterable[abc.Sequence[float]]) -> str:
    """The unit of several lists of one recording: that of their dates, or that of the list with the
    smallest steps."""
    sorted_lists = [sorted(numbers) for numbers in lists if len(numbers)]
    if not sorted_lists:
        return "s"
    dates = [unit for numbers in sorted_lists if (unit := date_unit(numbers[-1]))]
    steps = [step for numbers in sorted_lists if (step := _median_step(numbers)) > 0]
    return dates[0] if dates else _unit_of_step(min(steps, default=0.0))


def _median_step(increasing: abc.Sequence[float]) -> float:
    steps = [b - a for a, b in itertools.pairwise(increasing)]
    return statistics.median(steps) if steps else 0.0


def _unit_of_step(step: float) -> str:
    return next(unit for unit, most in LARGEST_STEP.items() if step <= most)


def _no_times(in_order: list[float], per_second: float) -> str:
    """Why these numbers, sorted, cannot be times; empty if they can."""
    n = len(in_order)
    if in_order[0] < 0:
        return f"{sum(v < 0 for v in in_order)} of {n} are negative, the smallest {in_order[0]:g}"
    if n == 1:
        return ""
    if in_order[0] == in_order[-1]:
        return f"all {n} are {in_order[0]:g}"
    steps = [b - a for a, b in itertools.pairwise(in_order)]
    n_repeats = sum(step == 0 for step in steps)
    if n_repeats > max(1, _REPEATED * n):
        return f"{n_repeats} of {n} repeat another"
    rate = per_second / statistics.median(steps)
    if rate > MOST_PER_SECOND:
        return (
            "sorted, they are far closer together than the frames of a camera, at "
            f"{in_order[0]:g} to {in_order[-1]:g}"
        )
    return ""


def _counter(in_order: list[float], *, is_padded: bool) -> str:
    """Why these numbers, sorted, are frame numbers; empty if they are not."""
    steps = [b - a for a, b in itertools.pairwise(in_order)]
    if len(steps) < 2 or not _may_count(in_order):
        return ""
    span = f"from {in_order[0]:g} to {in_order[-1]:g}"
    low = min(steps)
    if (
        0 < low < _COUNTER_STEP
        and statistics.median(steps) == low
        and all(step % low == 0 for step in steps)
    ):
        return f"they count the frames, {span}"
    if is_padded:
        return f"they number the frames, with leading zeros, {span}"
    if statistics.median(steps) < _LEAST_STEP_MS:
        return f"they number the frames, {span}: in milliseconds they would be too close together"
    return ""


def _may_count(in_order: list[float]) -> bool:
    """Whether these numbers, sorted, are whole and small enough to be those of frames."""
    return in_order[-1] < _COUNTER_BELOW and all(v == int(v) for v in in_order)
