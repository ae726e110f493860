"""Search for the value of an option at which a count reaches a target: few evaluations, each of which is a run."""

import math
from dataclasses import dataclass, field

MOST_RUNS = 24
"""Evaluations after which the search gives up."""
_FARTHEST = 8.0
"""Largest factor between the value of one evaluation and the next."""
_CLOSEST = 1e-3
"""Logarithm of the ratio of two values between which no others are tried."""


class NotReachedError(ValueError):
    """No value of the option reaches the target; the message says what the best ones reach."""


@dataclass(kw_only=True)
class Search:
    """A search for ``count(value) = target``; ``count`` is monotone, but the direction need not be known.

    It is asked for a value and told its count, until it has no further value:

        while (value := search.next_value()) is not None:
            search.tell(value, count(value))
        value = search.found()

    Values and counts are compared by their ratios. Between two values on both sides of the target it interpolates;
    outside it follows the slope.
    """

    target: float | int
    start: float | int
    """The first value, if it is between ``low`` and ``high``; else the nearer of these."""
    low: float | int
    high: float | int
    tolerance: float | int
    """A relative deviation from the target that is small enough to stop."""
    accepted: float | int = 0.0
    """A larger one that is accepted where no value comes closer, as for counts that change in steps."""
    whole: bool = False
    """Only whole numbers."""
    counts: dict[float | int, float | int] = field(default_factory=dict)
    """Value -> count, in the order of evaluation."""

    def next_value(self) -> float | int | None:
        """The value whose count is wanted next; None when the search has ended."""
        if not self.counts:
            return self._allowed(self.start)
        if len(self.counts) >= MOST_RUNS or self.error(self.best) <= self.tolerance:
            return None
        value = self._next()
        return None if value in self.counts else value

    def tell(self, value: float | int, count: float | int) -> None:
        """``count`` is the count at ``value``."""
        self.counts[value] = count

    @property
    def best(self) -> float | int:
        """The value whose count is closest to the target so far."""
        return min(self.counts, key=self.error)

    def found(self) -> float | int:
        """The best value, if it is close enough to the target.

        Raises:
            NotReachedError: it is not.
        """
        if self.error(self.best) > max(self.tolerance, self.accepted):
            raise NotReachedError(self._nearest())
        return self.best

    def error(self, value: float | int) -> float:
        """Relative deviation of the count at ``value`` from the target."""
        return abs(self.counts[value] - self.target) / self.target

    def _next(self) -> float | int:
        """The next value; one that is known already if no other can be better."""
        below = {v for v, n in self.counts.items() if n < self.target}
        above = set(self.counts) - below
        if below and above:
            a, b = min(((a, b) for a in below for b in above), key=lambda pair: abs(math.log(pair[0] / pair[1])))
            return a if abs(math.log(a / b)) < _CLOSEST else self._between(a, b)
        return self._beyond()

    def _between(self, a: float | int, b: float | int) -> float | int:
        """Interpolated in the logarithms; bisected when one end stays, so that it always ends."""
        share = self._log_ratio(self.target, a) / max(self._log_ratio(self.counts[b], a), 1e-9)
        recent = [n < self.target for n in list(self.counts.values())[-2:]]
        share = 0.5 if len(recent) == 2 and recent[0] == recent[1] else min(max(share, 0.1), 0.9)
        value = a * (b / a) ** share
        if not self.whole:
            return value
        between = range(math.floor(min(a, b)) + 1, math.ceil(max(a, b)))
        return min(between, key=lambda v: abs(v - value)) if between else a

    def _beyond(self) -> float | int:
        """Outside the values so far, towards the target."""
        a, b = min(self.counts), max(self.counts)
        if a == b:  # as if the count were proportional to the value
            factor = self._factor(self._log_ratio(self.target, a))
            value = self._moved(a, factor)
            return value if value != a else self._moved(a, 1 / factor)
        if self.counts[a] == self.counts[b]:  # no effect so far
            return self.high if self.high not in self.counts else self.low
        upwards = (self.counts[b] > self.counts[a]) == (self.target > self.counts[b])
        edge, *others = sorted(self.counts, reverse=upwards)
        if self.counts[edge] == self.counts[others[0]]:
            return self.high if upwards else self.low
        slope = self._log_ratio(self.counts[edge], others[0]) / math.log(edge / others[0])
        factor = self._factor(abs(self._log_ratio(self.target, edge) / slope))
        return self._moved(edge, factor if upwards else 1 / factor)

    def _factor(self, log_factor: float) -> float:
        """A factor for the next value: a change of at least a tenth, and not by too much."""
        size = min(max(abs(log_factor), math.log(1.1)), math.log(_FARTHEST))
        return math.exp(math.copysign(size, log_factor))

    def _moved(self, value: float | int, factor: float) -> float | int:
        moved = self._allowed(value * factor)
        if self.whole and moved == value:
            moved = self._allowed(value + (1 if factor > 1 else -1))
        return moved

    def _log_ratio(self, count: float | int, value: float | int) -> float:
        least = 1e-4 * self.target  # a count of zero has no logarithm
        return math.log(max(count, least) / max(self.counts[value], least))

    def _allowed(self, value: float | int) -> float | int:
        value = min(max(value, self.low), self.high)
        return round(value) if self.whole else value

    def _nearest(self) -> str:
        nearest = sorted(self.counts, key=self.error)[:2]
        if len(nearest) == 2 and len(set(self.counts.values())) == 1:
            a, b = nearest
            return f"this changes nothing: {a:g} and {b:g} both give {self.counts[a]:,.6g}"
        return " and ".join(f"{v:g} gives {self.counts[v]:,.6g}" for v in nearest)
