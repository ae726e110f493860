"""The search for the value of an option that gives a number of Gaussians."""

import itertools
import math
from collections.abc import Callable, Mapping

from ..errors import ForeseenError

MOST_RUNS = 24
"""Evaluations after which the search gives up."""
_FARTHEST = 8.0
"""Largest factor between the value of one evaluation and the next."""
_CLOSEST = 1e-3
"""Logarithm of the ratio of two values between which no others are tried."""
Number = float | int


class NotReachedError(ForeseenError, ValueError):
    """No value of the option reaches the target; the message says what the best ones reach."""


def search(
    count: Callable[[Number], Number],
    target: Number,
    *,
    start: Number,
    low: Number,
    high: Number,
    tolerance: Number,
    whole: bool = False,
    counts: dict[Number, Number] | None = None,
) -> dict[Number, Number]:
    """Search for ``count(value) = target``; ``count`` is monotone, but the direction need not be
    known.

    Values and counts are compared by their ratios. Between two values on both sides of the target
    it interpolates, or bisects when one end stays; outside it follows the slope.

    Args:
        count: What is counted at a value.
        target: The count that is wanted.
        start: The first value, if it is between ``low`` and ``high``; else the nearer of these.
        low, high: Limits of the values.
        tolerance: A relative deviation from the target that is small enough to stop.
        whole: Only whole numbers.
        counts: Counts that are known already.

    Returns:
        Value -> count, in the order of evaluation; the one nearest to the target may be farther
        than ``tolerance``.
    """
    counts = {} if counts is None else counts

    def clamp(value: Number) -> Number:
        value = min(max(value, low), high)
        return round(value) if whole else value

    def ratio(n: Number, m: Number) -> float:
        least = 1e-4 * target  # a count of zero has no logarithm
        return math.log(max(n, least) / max(m, least))

    def move(value: Number, log_factor: float) -> Number:
        """Another value, at least a tenth away and not too far."""
        size = min(max(abs(log_factor), math.log(1.1)), math.log(_FARTHEST))
        value_there = clamp(value * math.exp(math.copysign(size, log_factor)))
        return (
            clamp(value + math.copysign(1, log_factor))
            if whole and value_there == value
            else value_there
        )

    def between(a: Number, b: Number) -> Number:
        share = ratio(target, counts[a]) / max(ratio(counts[b], counts[a]), 1e-9)
        recent = [n < target for n in list(counts.values())[-2:]]
        share = 0.5 if len(recent) == 2 and recent[0] == recent[1] else min(max(share, 0.1), 0.9)
        value = a * (b / a) ** share
        if not whole:
            return value
        inner_values = range(
            math.floor(min(a, b)) + 1,
            math.ceil(max(a, b)),
        )
        return min(inner_values, key=lambda v: abs(v - value)) if inner_values else a

    def beyond() -> Number:
        a = min(counts)
        b = max(counts)
        if a == b:  # as if the count were proportional to the value
            value = move(a, ratio(target, counts[a]))
            return value if value != a else move(a, -ratio(target, counts[a]))
        if counts[a] == counts[b]:  # no effect so far
            return high if high not in counts else low
        upwards = (counts[b] > counts[a]) == (target > counts[b])
        edge, inner, *_ = sorted(counts, reverse=upwards)
        if counts[edge] == counts[inner]:
            return high if upwards else low
        slope = ratio(counts[edge], counts[inner]) / math.log(edge / inner)
        return move(
            edge,
            abs(ratio(target, counts[edge]) / slope) * (1 if upwards else -1),
        )

    def following() -> Number | None:
        """The value to try next; None if the search has ended."""
        if len(counts) >= MOST_RUNS or min(error_ratios(counts, target).values()) <= tolerance:
            return None
        low_values = [v for v, n in counts.items() if n < target]
        high_values = [v for v, n in counts.items() if n >= target]
        if not (low_values and high_values):
            return beyond()
        a, b = min(
            itertools.product(low_values, high_values),
            key=lambda pair: abs(math.log(pair[0] / pair[1])),
        )
        return None if abs(math.log(a / b)) < _CLOSEST else between(a, b)

    value = following() if counts else clamp(start)
    while value is not None and value not in counts:
        counts[value] = count(value)
        value = following()
    return counts


def nearest(counts: Mapping[Number, Number], target: Number, tolerance: Number) -> Number:
    """The value whose count is nearest to the target.

    Raises:
        NotReachedError: it differs by more than ``tolerance``.
    """
    errors = error_ratios(counts, target)
    best = sorted(counts, key=errors.__getitem__)[:2]
    if errors[best[0]] <= tolerance:
        return best[0]
    if len(best) == 2 and len(set(counts.values())) == 1:
        a, b = best
        raise NotReachedError(f"this changes nothing: {a:g} and {b:g} both give {counts[a]:,.6g}")
    raise NotReachedError(" and ".join(f"{v:g} gives {counts[v]:,.6g}" for v in best))


def error_ratios(counts: Mapping[Number, Number], target: Number) -> dict[Number, float]:
    """For each value, how far its count is from the target, as a share of the target."""
    return {value: abs(n - target) / target for value, n in counts.items()}
