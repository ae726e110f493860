"""Times of images: whether numbers are times and in which unit, ``times.txt``, and pairing two streams by time."""

import bisect
import itertools
import math
import statistics
from collections import abc
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...checks import shown
from ..sequence import SequenceError
from .poses import image_key, read_words

TIMES = "times.txt"


def associate(first_s: list[float], second_s: list[float], *, max_difference_s: float = 0.02) -> list[tuple[int, int]]:
    """Pairs (i, j) of the entries of two streams that are nearest in time, each entry used at most once.

    Candidates are taken in order of their time difference, so a worse pair never uses an entry of a better one (Sturm
    et al. 2012, the association of the TUM RGB-D benchmark).

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
        k = bisect.bisect_left(times, t - 2 * max_difference_s)  # wider, so that rounding excludes no candidate
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


def read_image_list(path: Path) -> tuple[list[float], list[Path]]:
    """Numbers, finite but not yet judged to be times, and files of a list with lines "timestamp filename".

    Raises:
        SequenceError: another line; names the file and the line.
    """
    numbers, files = [], []
    for number, words in read_words(path, "lines 'timestamp filename'"):
        try:
            value, image = float(words[0]), path.parent / words[1]
        except (ValueError, IndexError):
            value, image = math.nan, path
        if not math.isfinite(value):
            raise SequenceError(f"{path} line {number} must be 'timestamp filename', got {shown(' '.join(words))}")
        numbers.append(value)
        files.append(image)
    return numbers, files


def times_of_images(path: Path, images: list[Path]) -> tuple[list[tuple[float, float]] | None, str]:
    """Seconds of each image and of its depth, by its name, from lines "name seconds" or "name seconds depth_seconds".

    Returns:
        The times, or ``None`` and the reason why there are none.

    Raises:
        SequenceError: a line that is not a name and one or two numbers, or an image that is not in the file.
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
            raise SequenceError(f"{path} line {number} must be 'name seconds', got {shown(' '.join(words))}") from None
    lacking = [image for image in images if image_key(image.stem) not in time_of]
    if lacking:
        raise SequenceError(f"{path} has no time of {lacking[0]}; expected one per image")
    times = [time_of[image_key(image.stem)] for image in images]
    if not all(math.isfinite(t) for pair in times for t in pair):
        return None, f"{path.name} holds none"  # converted from a recording without times
    return times, ""


PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
LARGEST_STEP = {"s": 5.0, "ms": 5e3, "us": 5e5, "ns": float("inf")}
"""A median step above this belongs to the next finer unit: 5 s, 5 s, and 0.5 s, since 5e5 ns are 2 kHz."""
MOST_PER_SECOND = 1000.0
"""No depth camera takes more frames per second: numbers that are nearer to each other are not times."""
_REPEATED = 0.1
"""Share of equal neighbours above which numbers are not times."""
_COUNTER_BELOW, _COUNTER_STEP = 1e6, 20
"""Whole numbers below the first with a constant step below the second count frames; a clock has larger numbers, and in
milliseconds larger steps."""


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


def judge_stamps(numbers: abc.Sequence[float], *, names: abc.Sequence[Any] = (), unit: str = "auto") -> Stamps:
    """Are these numbers the times at which images were taken?

    Durations of the frames, frame counters, equal or negative numbers are not. Numbers that do not
    increase in the order given are times only if the names of the images say the same order.

    Args:
        numbers: Finite numbers, in the order of the list or file.
        names: Sorting keys of the images' names; empty where nothing but the numbers tells an order.
        unit: "s", "ms", "us" or "ns" where the file's format fixes it; "auto" finds it by the numbers.
    """
    values, ordered = list(numbers), sorted(numbers)
    if not values:
        return Stamps([])
    found = time_unit(ordered) if unit == "auto" else unit
    reason = _no_times(ordered, PER_SECOND[found]) or (_counter(ordered) if unit == "auto" else "")
    times = [v / PER_SECOND[found] for v in values]
    backward = sum(b < a for a, b in itertools.pairwise(values))
    if backward and not reason:
        by_time = sorted(range(len(values)), key=values.__getitem__)
        if names and [names[i] for i in by_time] == sorted(names):
            return Stamps(times, unit=found, unordered=backward)
        reason = f"{backward} of {len(values)} are smaller than the one before"
    return Stamps(None, reason, found) if reason else Stamps(times, unit=found)


def time_unit(increasing: abc.Sequence[float]) -> str:
    """Unit in which times since 1970 fall between 2001 and 2286, or in which the median step is that of a camera."""
    last = abs(float(increasing[-1]))
    steps = [b - a for a, b in itertools.pairwise(increasing)]
    step = statistics.median(steps) if steps else 0.0
    since_1970 = next((unit for unit, n in PER_SECOND.items() if 1e9 <= last / n < 1e10), None)
    return since_1970 or next(unit for unit, most in LARGEST_STEP.items() if step <= most)


def _no_times(ordered: list[float], per_second: float) -> str:
    """Why these numbers, sorted, cannot be times; empty if they can."""
    n = len(ordered)
    if ordered[0] < 0:
        return f"{sum(v < 0 for v in ordered)} of {n} are negative, the smallest {ordered[0]:g}"
    if n == 1:
        return ""
    if ordered[0] == ordered[-1]:
        return f"all {n} are {ordered[0]:g}"
    steps = [b - a for a, b in itertools.pairwise(ordered)]
    repeated = sum(step == 0 for step in steps)
    if repeated > max(1, _REPEATED * n):
        return f"{repeated} of {n} repeat another"
    rate = per_second / statistics.median(steps)
    if rate > MOST_PER_SECOND:
        return f"sorted, they are far closer together than the frames of a camera, at {ordered[0]:g} to {ordered[-1]:g}"
    return ""


def _counter(ordered: list[float]) -> str:
    """Why these numbers, sorted, are frame numbers; empty if they are not."""
    steps = [b - a for a, b in itertools.pairwise(ordered)]
    if len(steps) < 2 or ordered[-1] >= _COUNTER_BELOW or any(v != int(v) for v in ordered):
        return ""
    low = min(steps)
    counts = 0 < low < _COUNTER_STEP and statistics.median(steps) == low and all(step % low == 0 for step in steps)
    return f"they count the frames, from {ordered[0]:g} to {ordered[-1]:g}" if counts else ""
