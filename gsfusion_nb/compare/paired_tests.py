"""Which differences between rules are more than noise: paired tests over scenes, by SciPy.

A test is only worth its p value if what it compares was named before the numbers were seen. So all
rules are tested against one that is named before (``named_reference``), or all pairs are, or all
ranks at once (``TESTS``).
"""

import itertools
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ..errors import UnknownNameError
from .scene_units import scene_units
from .statistics import COLUMNS, FIRST_METRIC, group_runs, standings

if TYPE_CHECKING:
    from .run_result import RunResult
    from .spec import RunSpec


Verdict = Literal["a", "b", "noise", "equal", "unknown"]
SIGNIFICANCE = 0.05
"""A difference with a smaller p value is called more than noise."""
TESTS = {
    "reference": "each rule against one that is named before, paired t tests, Holm's correction",
    "pairs": "every pair of rules, paired t tests, Holm's correction for all pairs",
    "nemenyi": "the ranks of all rules, Friedman's test and Nemenyi's for each pair",
}
"""Name of what is tested at each budget -> what it is."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The paired comparison of two rules, "a" and "b"; differences are a - b.

    ``str`` says it in words. All numbers are in the unit of the metric.
    """

    a: str
    b: str
    metric: str
    differences: dict[str, list[float]]
    """Unit (a scene, or several that share frames) -> difference of each pair of runs with the same
    seed and budget, the mean over the unit's scenes. On a single unit pairs whose maps are equal to
    those of an earlier one are left out: they are the same observation."""
    n_pairs: int
    """Number of pairs of runs."""
    n_scenes: int
    """Number of scenes that they are on."""
    mean: float
    """Mean over the units; NaN without a pair."""
    interval: tuple[float, float]
    """95 % confidence interval of the mean difference by Student's t; NaN with fewer than two
    units."""
    p: float
    """Two-sided p value of the paired t test."""
    corrected: float = math.nan
    """``p`` corrected for several comparisons; NaN if there is one."""
    n_tests: int = 1
    """Number of comparisons that it is corrected for."""

    @property
    def units(self) -> list[float]:
        """What is tested: a difference for each unit, the mean over its seeds; on a single one, one
        for each seed."""
        return _units(self.differences)

    @property
    def verdict(self) -> Verdict:
        """Which rule is better, or that this cannot be said. ``corrected`` decides where it is
        known."""
        better = COLUMNS[self.metric].better
        if len(self.units) < 2:
            return "unknown"
        if not any(self.units):
            return "equal"
        p = self.p if math.isnan(self.corrected) else self.corrected
        if p >= SIGNIFICANCE or math.isnan(p) or better == "neither":
            return "noise"
        return "a" if (self.mean > 0) == (better == "higher") else "b"

    def towards(self, reference: str) -> "Comparison":
        """The same comparison with ``reference``, if it is one of the two, as ``b``."""
        if self.a != reference:
            return self
        low, high = self.interval
        differences = {unit: [-d for d in of] for unit, of in self.differences.items()}
        return replace(
            self,
            a=self.b,
            b=self.a,
            differences=differences,
            mean=-self.mean,
            interval=(-high, -low),
        )

    def __str__(self) -> str:
        column = COLUMNS[self.metric]
        if self.verdict == "unknown":
            return (
                f"{self.a} and {self.b}: nothing can be said about noise from {self._pairs()}; "
                "use several scenes"
            )
        if self.verdict == "equal":
            return f"{self.a} and {self.b} have the same {column.heading} in {self._pairs()}"
        unit = f" {column.unit}" if column.unit else ""
        low, high = map(
            column.text,
            self.interval if self.mean >= 0 else (-self.interval[1], -self.interval[0]),
        )
        evidence = (
            f"95 % interval {low} to {high}{unit}; {self._pairs()}; paired t test: {p_text(self.p)}"
        )
        if self.n_tests > 1:
            evidence += f", corrected for {self.n_tests} comparisons: {p_text(self.corrected)}"
        size = f"{column.text(abs(self.mean))}{unit} {column.heading}"
        if self.verdict == "noise":
            return f"{self.a} and {self.b} differ by {size}, which is within noise ({evidence})"
        winner, loser = (self.a, self.b) if self.verdict == "a" else (self.b, self.a)
        return f"{winner} is better than {loser} by {size}, which is more than noise ({evidence})"

    def _pairs(self) -> str:
        """How many pairs of runs there are, and why they count as fewer."""
        n_units = len(self.differences)
        seeds = sum(map(len, self.differences.values()))
        words = f"{self.n_pairs} pairs of runs on {self.n_scenes} scene{'s' * (self.n_scenes > 1)}"
        if n_units < self.n_scenes:
            words += f", which share frames and count as {n_units}"
        if n_units == 1 and seeds * self.n_scenes < self.n_pairs:
            words += f", in which the seeds made {seeds} different pair{'s' * (seeds > 1)} of maps"
        return words


def compare(
    results: "Iterable[RunResult]",
    a: str,
    b: str,
    *,
    budget: str | None = None,
    metric: str = FIRST_METRIC,
    units: Mapping[str, str] | None = None,
) -> Comparison:
    """Is the difference between two rules more than noise?

    Each run of rule ``a`` is paired with the run of rule ``b`` that has the same scene, seed and
    budget. The pairs of a scene give one difference, their mean, because seeds change only random
    draws and share everything else. Scenes that share frames give one together. Student's paired t
    test (scipy) then has one unit for each scene: it asks whether other scenes of this kind would
    show the same. On a single scene the seeds are the units, and the answer is about its draws
    only.

    Args:
        results: Runs of the lab; failed runs are left out, together with their partners.
        a, b: Labels of the two rules.
        budget: Only runs with this budget (its text); all by default.
        metric: Name of the number, one of ``COLUMNS``.
        units: Scene -> unit; ``scene_units`` of ``results`` if None.

    Raises:
        KeyError: a label without any run, or an unknown metric.
    """
    COLUMNS[metric]
    results = list(results)
    units = scene_units(results) if units is None else units
    of_label: dict[str, dict[tuple[str, str, int], RunResult]] = {}
    for result in results:
        spec = result.spec
        value = result.metrics.get(metric, math.nan)
        own = of_label.setdefault(spec.label, {})
        if math.isfinite(value) and budget in (None, str(spec.budget)):
            own[spec.scene, str(spec.budget), spec.seed] = result
    for label in (a, b):
        if label not in of_label:
            raise UnknownNameError(
                f"no runs of {label!r}; there are: {', '.join(sorted(of_label)) or 'none'}"
            )
    pairs = {
        place: (of_a, of_label[b][place])
        for place, of_a in of_label[a].items()
        if place in of_label[b]
    }
    differences = _differences(pairs, metric, units)
    unit_differences = _units(differences)
    interval, p = paired_test(unit_differences)
    return Comparison(
        a=a,
        b=b,
        metric=metric,
        differences=differences,
        n_pairs=len(pairs),
        n_scenes=len({s for s, _, _ in pairs}),
        mean=float(np.mean(unit_differences)) if unit_differences else math.nan,
        interval=interval,
        p=p,
    )


def _differences(
    pairs: "Mapping[tuple[str, str, int], tuple[RunResult, RunResult]]",
    metric: str,
    units: Mapping[str, str],
) -> dict[str, list[float]]:
    """``Comparison.differences`` from the pair of runs of each scene, budget and seed."""
    by_unit: dict[str, dict[tuple[str, int], list[tuple[RunResult, RunResult]]]] = {}
    for (scene, budget, seed), pair in pairs.items():
        by_unit.setdefault(units.get(scene, scene), {}).setdefault((budget, seed), []).append(pair)
    unit_differences: dict[str, list[float]] = {}
    for unit, by_seed in by_unit.items():
        of_maps: dict[Any, float] = {}
        for place, of_scenes in by_seed.items():
            hashes = tuple((x.spec.scene, x.map_hash, y.map_hash) for x, y in of_scenes)
            is_known = len(by_unit) == 1 and all(x and y for _, x, y in hashes)
            difference = float(
                np.mean([x.metrics[metric] - y.metrics[metric] for x, y in of_scenes])
            )
            of_maps.setdefault((place[0], hashes) if is_known else place, difference)
        unit_differences[unit] = list(of_maps.values())
    return unit_differences


def named_reference(specs: "Iterable[RunSpec]") -> str:
    """Label of the rule that all others are tested against where none is named; it does not depend
    on any result.

    The rule ``gsfusion`` with its own options where it takes part, else the first. Empty without
    any run.
    """
    specs = list(specs)
    gsfusion_labels = [spec.label for spec in specs if spec.rule == "gsfusion"]
    plain = [spec.label for spec in specs if spec.rule == "gsfusion" and not spec.options]
    return next(
        iter([*plain, *gsfusion_labels, *(spec.label for spec in specs)]),
        "",
    )


def against_reference(
    results: "Sequence[RunResult]",
    budget: str,
    reference: str = "",
    metric: str = FIRST_METRIC,
) -> list[Comparison]:
    """Each rule (a) against the reference (b) at one budget, best rule first, with p values
    corrected by Holm's method.

    Args:
        results: All runs.
        budget: Text of the budget.
        reference: Label of a rule, chosen before the results were known; ``named_reference`` if
            empty.
        metric: Name of the number, one of ``COLUMNS``.

    Returns:
        The comparisons; none if the reference has no completed run at this budget.
    """
    reference = reference or named_reference(result.spec for result in results)
    labels = _labels(results, budget)
    if reference not in labels:
        return []
    units = scene_units(results)
    comparisons = [
        compare(results, label, reference, budget=budget, metric=metric, units=units)
        for label in labels
        if label != reference
    ]
    return corrected(comparisons)


def all_pairs(
    results: "Sequence[RunResult]", budget: str, metric: str = FIRST_METRIC
) -> list[Comparison]:
    """Every pair of rules at one budget, the better rules first, with p values corrected for all
    pairs by Holm's method."""
    units = scene_units(results)
    pairs = itertools.combinations(_labels(results, budget), 2)
    return corrected(
        [compare(results, a, b, budget=budget, metric=metric, units=units) for a, b in pairs]
    )


def _labels(results: "Iterable[RunResult]", budget: str) -> list[str]:
    """The rules with a completed run at a budget, best first."""
    groups = [group for group in group_runs(results) if group.budget == budget]
    complete = {group.label for group in groups if group.runs}
    return [standing.label for standing in standings(groups) if standing.label in complete]


def corrected(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """The comparisons with p values corrected for their number (``holm``).

    A NaN is a test that could not be made: it stays NaN and is not counted.
    """
    tests = [i for i, c in enumerate(comparisons) if not math.isnan(c.p)]
    p_values = dict.fromkeys(range(len(comparisons)), math.nan)
    p_values |= dict(zip(tests, holm([comparisons[i].p for i in tests]), strict=True))
    return [
        replace(c, corrected=p_values[i], n_tests=len(tests)) for i, c in enumerate(comparisons)
    ]


def holm(p_values: Sequence[float]) -> list[float]:
    """The p values of several tests, corrected for their number by the step-down method of Holm
    (1979): the k-th smallest of n, counted from 0, times n - k, no smaller than the one before.

    ``multipletests`` of statsmodels, beside which the tests hold it, has the same values. But it
    collects the garbage of the whole process in each call, 0.1 s with a map in memory, and a table
    makes a hundred calls.
    """
    order = np.argsort(p_values)
    steps = np.asarray(p_values, float)[order] * np.arange(len(order), 0, -1)
    result = np.empty(len(order))
    result[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return result.tolist()


def paired_test(differences: Sequence[float]) -> tuple[tuple[float, float], float]:
    """95 % interval of the mean by Student's t, and p of the paired t test, both of scipy.

    NaN with fewer than two differences. If all differences are the same, the interval is that
    value, and p is 0, or 1 if the value is zero.
    """
    from scipy import stats

    if len(differences) < 2:
        return (math.nan, math.nan), math.nan
    if not any(differences):
        return (0.0, 0.0), 1.0
    # about differences that are all the same
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        t: Any = stats.ttest_1samp(differences, 0.0)
        interval: Any = t.confidence_interval(0.95)
    return (float(interval.low), float(interval.high)), float(t.pvalue)


def p_text(p: float) -> str:
    """A p value as text: "p = 0.032", "p < 0.001"."""
    return "p unknown" if math.isnan(p) else "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def _units(differences: dict[str, list[float]]) -> list[float]:
    if len(differences) == 1:
        return list(next(iter(differences.values())))
    return [float(np.mean(of_scene)) for of_scene in differences.values()]
