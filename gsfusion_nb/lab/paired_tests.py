"""Is a difference between two rules more than noise? Paired tests over seeds and scenes."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float

from .columns import COLUMNS, FIRST_METRIC

if TYPE_CHECKING:
    from .result import RunResult

Verdict = Literal["a", "b", "noise", "equal", "unknown"]

SIGNIFICANCE = 0.05
"""A difference with a smaller p value is called more than noise."""
RESAMPLES = 10_000
"""Resamples of the bootstrap."""
EXACT_PAIRS = 16
"""Up to this number of pairs, the signed-rank test goes through all 2^n sign patterns."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The paired comparison of two rules, "a" and "b"; differences are a - b.

    ``str`` says it in words. All numbers are in the unit of the metric.
    """

    a: str
    b: str
    metric: str
    differences: dict[str, list[float]]
    """Scene -> difference of each pair of runs with the same seed."""
    mean: float
    """Mean difference; NaN without a pair."""
    interval: tuple[float, float]
    """95 % confidence interval of the mean difference by Student's t; NaN with fewer than two pairs."""
    bootstrap: tuple[float, float]
    """95 % percentile bootstrap interval over pairs; too narrow for fewer than about ten pairs."""
    p_t: float
    """Two-sided p value of the paired t test."""
    p_signed_rank: float
    """Two-sided p value of Wilcoxon's signed-rank test; with n pairs it cannot be below 2 / 2^n."""
    verdict: Verdict
    """Which rule is better, or that this cannot be said."""
    failed: dict[str, str] = field(default_factory=dict)
    """Rule without any completed run -> why its first run failed."""

    @property
    def n(self) -> int:
        """Number of pairs."""
        return sum(map(len, self.differences.values()))

    @property
    def opposite_scenes(self) -> tuple[list[str], list[str]]:
        """Scenes on which a is better, and on which b is, each by more than noise; empty unless there are both kinds.

        Each scene is tested by itself, over its seeds.
        """
        higher, found = COLUMNS[self.metric].better == "higher", ([], [])
        for scene, values in self.differences.items():
            d = np.array(values)
            if paired_t(d)[1] < SIGNIFICANCE:
                found[0 if (d.mean() > 0) == higher else 1].append(scene)
        return found if all(found) else ([], [])

    def __str__(self) -> str:
        column = COLUMNS[self.metric]
        unit = f" {column.unit}" if column.unit else ""
        pairs = f"{self.n} pairs of runs on {_count(len(self.differences), 'scene')}"
        if self.failed:
            reasons = "; ".join(f"all runs of {label} failed: {reason}" for label, reason in self.failed.items())
            return f"{self.a} and {self.b}: nothing can be said about noise, because {reasons}"
        if self.verdict == "unknown":
            have = f"{_count(self.n, 'pair')} of runs with one seed" if self.n else "no pair of completed runs"
            return f"{self.a} and {self.b}: nothing can be said about noise from {have}; use at least three seeds"
        if self.verdict == "equal":
            return f"{self.a} and {self.b} have the same {column.heading} in all {pairs}"
        ends = self.interval if self.mean >= 0 else (-self.interval[1], -self.interval[0])
        low, high = map(column.text, ends)  # around the size, which has no sign
        size = column.text(abs(self.mean))
        evidence = f"95 % interval {low} to {high}{unit}; {pairs}; paired t test: {p_text(self.p_t)}"
        if self.verdict == "noise":
            text = f"{self.a} and {self.b} differ by {size}{unit} {column.heading}, which is within noise ({evidence})"
            of_a, of_b = self.opposite_scenes
            if of_a:
                text += f"; but {self.a} is better on {', '.join(of_a)}, and {self.b} on {', '.join(of_b)}"
            return text
        winner, loser = (self.a, self.b) if self.verdict == "a" else (self.b, self.a)
        return (
            f"{winner} is better than {loser} by {size}{unit} {column.heading}, which is more than noise ({evidence})"
        )


def compare(
    results: "Iterable[RunResult]", a: str, b: str, *, budget: str | None = None, metric: str = FIRST_METRIC
) -> Comparison:
    """Is the difference between two rules more than noise?

    Each run of rule ``a`` is paired with the run of rule ``b`` that has the same scene, seed and budget. One pair gives
    one difference of the two means over all views. Views are not counted as separate observations: those of one run see
    the same map and rise and fall together, so counting them would make almost every difference look certain.

    The t test assumes that the differences are independent draws from one normal distribution. Seeds of one scene share
    this scene; the test therefore answers "would other seeds on these scenes show the same?", and says less about other
    scenes. If the rules differ by different amounts from scene to scene, this variation counts as noise, which makes
    the test cautious.

    Args:
        results: Runs of the lab; failed runs are left out, together with their partners.
        a, b: Labels of the two rules.
        budget: Only runs with this budget (its text); all by default.
        metric: Name of the number, one of ``COLUMNS``.

    Raises:
        KeyError: a label without any run, or an unknown metric.
    """
    column, results = COLUMNS[metric], list(results)
    seen = {result.spec.label for result in results}
    for label in (a, b):
        if label not in seen:
            known = f"there are: {', '.join(sorted(seen))}" if seen else "there are none"
            raise KeyError(f"no runs of {label!r}; {known}")
    chosen = [r for r in results if r.spec.label in (a, b) and budget in (None, str(r.spec.budget))]
    values: dict[str, dict[tuple[str, int, str], float]] = {a: {}, b: {}}
    for result in chosen:
        spec, value = result.spec, result.metrics.get(metric, math.nan)
        if math.isfinite(value):
            values[spec.label][spec.scene, spec.seed, str(spec.budget)] = value
    differences: dict[str, list[float]] = {}
    seeds = set()
    for place, value in values[a].items():
        if place in values[b]:
            differences.setdefault(place[0], []).append(value - values[b][place])
            seeds.add(place[1])
    d = np.array([v for of_scene in differences.values() for v in of_scene], float)
    mean = float(d.mean()) if len(d) else math.nan
    interval, p = paired_t(d)
    verdict: Verdict = "noise"
    if len(seeds) < 2:
        verdict = "unknown"
    elif not d.any():
        verdict = "equal"
    elif p < SIGNIFICANCE and column.better != "neither":
        verdict = "a" if (mean > 0) == (column.better == "higher") else "b"
    return Comparison(
        a=a, b=b, metric=metric, differences=differences, mean=mean, interval=interval, bootstrap=bootstrap_interval(d),
        p_t=p, p_signed_rank=signed_rank_p(d), verdict=verdict,
        failed=_all_failed(chosen, (a, b)),
    )  # fmt: skip


def _all_failed(results: "Sequence[RunResult]", labels: Iterable[str]) -> dict[str, str]:
    """Label -> reason of its first run, of the labels whose runs all failed."""
    found = {}
    for label in labels:
        own = [r for r in results if r.spec.label == label]
        if own and all(r.status == "failed" for r in own):
            found[label] = own[0].reason
    return found


def paired_t(differences: Float[np.ndarray, "N"]) -> tuple[tuple[float, float], float]:
    """95 % confidence interval of the mean, and the two-sided p value of Student's t test against zero.

    NaN with fewer than two differences. If all differences are the same, the interval is that value, and p is 0, or 1
    if the value is zero.
    """
    from scipy import special

    n = len(differences)
    if n < 2:
        return (math.nan, math.nan), math.nan
    mean, error = float(differences.mean()), float(differences.std(ddof=1)) / math.sqrt(n)
    if error <= 1e-12 * abs(mean):
        return (mean, mean), float(mean == 0.0)
    half = float(special.stdtrit(n - 1, 0.975)) * error
    return (mean - half, mean + half), 2.0 * float(special.stdtr(n - 1, -abs(mean) / error))


def signed_rank_p(differences: Float[np.ndarray, "N"]) -> float:
    """Two-sided p value of Wilcoxon's signed-rank test (zeros left out, average ranks for ties).

    Exact, from all sign patterns, up to ``EXACT_PAIRS`` differences; above, scipy's normal approximation. NaN without a
    difference, 1 if all are zero.
    """
    from scipy import stats

    if len(differences) == 0:
        return math.nan
    d = differences[differences != 0]
    if len(d) == 0:
        return 1.0
    if len(d) > EXACT_PAIRS:
        return float(stats.wilcoxon(d, method="approx", correction=True).pvalue)  # pyright: ignore
    ranks = stats.rankdata(np.abs(d))
    signs = (np.arange(2 ** len(d))[:, None] >> np.arange(len(d)) & 1) * 2 - 1
    sums = np.abs(signs @ ranks)
    return float(np.mean(sums >= abs(np.sign(d) @ ranks) - 1e-9))


def bootstrap_interval(differences: Float[np.ndarray, "N"], *, seed: int = 0) -> tuple[float, float]:
    """95 % percentile interval of the mean, from ``RESAMPLES`` resamples of the differences; NaN with fewer than
    two."""
    n = len(differences)
    if n < 2:
        return math.nan, math.nan
    chosen = np.random.default_rng(seed).integers(0, n, (RESAMPLES, n))
    low, high = np.percentile(differences[chosen].mean(axis=1), (2.5, 97.5))
    return float(low), float(high)


def holm(p_values: Sequence[float]) -> list[float]:
    """p values corrected for the number of tests by the step-down method of Holm (1979), in the order given.

    A NaN is a test that could not be made: it stays NaN and is not counted.
    """
    known = [i for i in np.argsort(p_values, kind="stable") if not math.isnan(p_values[i])]
    corrected, largest = [math.nan] * len(p_values), 0.0
    for position, i in enumerate(known):
        largest = max(largest, min(1.0, (len(known) - position) * p_values[i]))
        corrected[i] = largest
    return corrected


def p_text(p: float) -> str:
    """A p value as text: "p = 0.032", "p < 0.001"."""
    return "p unknown" if math.isnan(p) else "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
