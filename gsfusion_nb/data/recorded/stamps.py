"""Whether numbers are the times at which images were taken, and in which unit."""

import itertools
import statistics
from collections import abc
from dataclasses import dataclass
from typing import Any

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
    counter = counter_reason(in_order, is_padded=padded) if unit == "auto" else ""
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
    return date_unit(increasing[-1]) or _unit_of_step(median_step(increasing))


def common_unit(lists: abc.Iterable[abc.Sequence[float]]) -> str:
    """The unit of several lists of one recording: that of their dates, or that of the list with the
    smallest steps."""
    sorted_lists = [sorted(numbers) for numbers in lists if len(numbers)]
    if not sorted_lists:
        return "s"
    dates = [unit for numbers in sorted_lists if (unit := date_unit(numbers[-1]))]
    steps = [step for numbers in sorted_lists if (step := median_step(numbers)) > 0]
    return dates[0] if dates else _unit_of_step(min(steps, default=0.0))


def median_step(increasing: abc.Sequence[float]) -> float:
    """The median difference of neighbours; 0 of fewer than two numbers."""
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


def counter_reason(in_order: list[float], *, is_padded: bool) -> str:
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
