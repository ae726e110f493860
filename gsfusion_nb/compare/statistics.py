"""What several runs say together: the numbers shown, means and spreads, ranks, paired tests over scenes."""

import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float

from ..evaluation.metrics import METRICS

Better = Literal["higher", "lower", "neither"]
Views = Literal["held out", "between neighbours", "mapped", ""]


@dataclass(frozen=True, kw_only=True)
class Column:
    """One number of a run, as the tables show it."""

    metric: str
    """Name in ``RunResult.metrics``."""
    heading: str
    views: Views = ""
    """The views that it is the mean of; empty if it belongs to the whole run."""
    unit: str = ""
    digits: int = 2
    scale: float = 1.0
    """Factor from the stored unit to the shown one."""
    better: Better = "neither"
    group: Literal["quality", "cost"] = "quality"
    """Wide tables are split into these two."""

    @property
    def name(self) -> str:
        """Heading, views and unit in one text: "PSNR held out, dB"."""
        words = f"{self.heading} {self.views}".strip()
        return f"{words}, {self.unit}" if self.unit else words

    def shown(self, value: float) -> float:
        """A value in the unit of the table, rounded to the digits that are shown."""
        return round(value * self.scale, self.digits)

    def text(self, value: float) -> str:
        """A value as text, without its unit; "–" for NaN."""
        number = self.shown(value)
        if number != number:
            return "–"
        return "∞" if number == float("inf") else f"{number:,.{self.digits}f}"


def _columns() -> Iterable[Column]:
    """All columns, in the order of the tables: names, units and digits are those of ``METRICS``."""
    groups: dict[str, Views] = {"held_out": "held out", "held_out_between": "between neighbours", "mapped": "mapped"}
    images: dict[str, Better] = {"psnr_{}_db": "higher", "ssim_{}": "higher", "lpips_{}": "lower"}
    images["depth_l1_{}_m"] = "lower"
    for name, better in images.items():
        for views, words in groups.items():
            yield _column(name.format(views), better, views=words)
    for name in ("psnr_held_out_online_db", "psnr_mapped_online_db", "ssim_held_out_online"):
        heading, _, views = METRICS[name].label.partition(", ")
        yield _column(name, "higher", heading=f"{heading} online", views=views)
    yield _column("mesh_accuracy_m", "lower", heading="Mesh accuracy")
    yield _column("mesh_completion_m", "lower", heading="Mesh completion")
    yield _column("mesh_psnr_held_out_db", "higher", heading="Mesh PSNR held out")
    yield _column("ate_rmse_m", "lower")
    yield _column("drift_m", "lower")
    yield Column(metric="n_gaussians", heading="Gaussians", digits=0, better="lower", group="cost")
    yield Column(metric="n_keyframes", heading="Keyframes", digits=0, group="cost")
    yield Column(metric="n_steps", heading="Gradient steps", digits=0, group="cost")
    costs = {
        "ms_per_frame": "Time per frame",
        "cpu_ms_per_frame": "CPU time per frame",
        "seeding_ms": "Seeding per frame",
    }
    for name, heading in costs.items():
        yield Column(metric=name, heading=heading, unit="ms", digits=1, better="lower", group="cost")
    yield _column("seconds_total", "lower", group="cost")
    yield _column("peak_memory_mb", "lower", heading="Memory", group="cost")
    for name in ("fps_total", "fps_mapping", "fps_tracking"):
        yield _column(name, "higher", group="cost")


def _column(metric: str, better: Better, **changes: Any) -> Column:
    known = METRICS[metric]
    words: dict[str, Any] = {"heading": known.label, "unit": known.unit, "digits": known.digits, "scale": known.scale}
    return Column(metric=metric, better=better, **(words | changes))


COLUMNS: Mapping[str, Column] = {column.metric: column for column in _columns()}
"""Name of a number -> its column, in the order of the tables."""

FIRST_METRIC = "psnr_held_out_db"
"""The number that rules are ranked and compared by, unless another one is asked for."""


if TYPE_CHECKING:
    from .spec import RunResult

Verdict = Literal["a", "b", "noise", "equal", "unknown"]

SIGNIFICANCE = 0.05
"""A difference with a smaller p value is called more than noise."""


@dataclass(frozen=True)
class Summary:
    """Mean and spread of one number over the runs of a group, or over scenes."""

    mean: float
    """NaN without a value."""
    sd: float
    """Sample standard deviation (divisor n - 1); NaN with fewer than two values."""
    n: int
    """Number of values."""


def summarise(values: Iterable[float]) -> Summary:
    """Mean, sample standard deviation and number of the values that are not NaN."""
    known = np.array([v for v in values if not math.isnan(v)], float)
    if len(known) == 0:
        return Summary(math.nan, math.nan, 0)
    spread = len(known) > 1 and bool(np.isfinite(known).all())
    return Summary(float(known.mean()), float(known.std(ddof=1)) if spread else math.nan, len(known))


@dataclass(frozen=True, kw_only=True)
class Group:
    """The runs of one rule on one scene at one budget: the same settings with different seeds."""

    label: str
    scene: str
    budget: str
    runs: "tuple[RunResult, ...]"
    """Runs that were completed."""
    failed: "tuple[RunResult, ...]" = ()

    @property
    def fixes_cost(self) -> bool:
        """Whether the budget gives every rule the same size or time, so that these are left-overs of the tuning."""
        budgets = [run.spec.budget for run in (*self.runs, *self.failed)]
        return any(b.gaussians is not None or b.seconds is not None for b in budgets)

    def values(self, metric: str) -> list[float]:
        """The number in each completed run that has it."""
        return [v for run in self.runs if not math.isnan(v := run.metrics.get(metric, math.nan))]

    def summary(self, metric: str) -> Summary:
        """Over the completed runs; a run without this number does not count."""
        return summarise(self.values(metric))


def group_runs(results: "Iterable[RunResult]") -> list[Group]:
    """Runs by label, scene and budget, in the order in which these were first seen."""
    found: dict[tuple[str, str, str], tuple[list[RunResult], list[RunResult]]] = {}
    for result in results:
        spec = result.spec
        done, failed = found.setdefault((spec.label, spec.scene, str(spec.budget)), ([], []))
        (done if result.status == "done" else failed).append(result)
    return [
        Group(label=label, scene=scene, budget=budget, runs=tuple(done), failed=tuple(failed))
        for (label, scene, budget), (done, failed) in found.items()
    ]


def by_budget(groups: Sequence[Group]) -> list[list[Group]]:
    """The groups of each budget."""
    return [[g for g in groups if g.budget == budget] for budget in dict.fromkeys(g.budget for g in groups)]


@dataclass(frozen=True, kw_only=True)
class Standing:
    """One rule over all scenes of a comparison, at one budget."""

    label: str
    ranks: dict[str, float]
    """Scene -> rank by the mean over seeds, 1 is best; ties share the mean of their ranks."""
    over_scenes: Summary
    """Of the means of the scenes. NaN if the rule has no result on one of them."""

    @property
    def rank(self) -> float:
        """Mean rank over the scenes; NaN if the rule has no result on one of them."""
        return math.nan if math.isnan(self.over_scenes.mean) else float(np.mean(list(self.ranks.values())))


def standings(groups: Sequence[Group], *, metric: str = FIRST_METRIC) -> list[Standing]:
    """The rules of one budget, best mean over the scenes first; those without a result on some scene come last.

    Means that are equal in the digits of the tables share a rank.

    Raises:
        ValueError: groups of several budgets, or a metric without a better direction.
    """
    from scipy.stats import rankdata

    column = COLUMNS[metric]
    if column.better == "neither":
        raise ValueError(f"rules cannot be ranked by {metric}: neither direction is better")
    if len({group.budget for group in groups}) > 1:
        raise ValueError("ranks compare rules at one budget; give the groups of one budget")
    scenes, sign = list(dict.fromkeys(group.scene for group in groups)), -1.0 if column.better == "higher" else 1.0
    means: dict[str, dict[str, float]] = {group.label: {} for group in groups}
    ranks: dict[str, dict[str, float]] = {group.label: {} for group in groups}
    for group in groups:
        if (summary := group.summary(metric)).n:
            means[group.label][group.scene] = summary.mean
    for scene in scenes:
        here = {label: column.shown(of[scene]) for label, of in means.items() if scene in of}
        for label, rank in zip(here, rankdata([sign * m for m in here.values()]).tolist(), strict=True):
            ranks[label][scene] = float(rank)
    nothing = Summary(math.nan, math.nan, 0)
    found = [
        Standing(
            label=label, ranks=ranks[label], over_scenes=summarise(of.values()) if len(of) == len(scenes) else nothing
        )
        for label, of in means.items()
    ]
    return sorted(found, key=lambda s: (math.isnan(s.over_scenes.mean), sign * s.over_scenes.mean, -len(s.ranks)))


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The paired comparison of two rules, "a" and "b"; differences are a - b.

    ``str`` says it in words. All numbers are in the unit of the metric.
    """

    a: str
    b: str
    metric: str
    differences: dict[str, list[float]]
    """Scene -> difference of each pair of runs with the same seed and budget."""
    mean: float
    """Mean over the units; NaN without a pair."""
    interval: tuple[float, float]
    """95 % confidence interval of the mean difference by Student's t; NaN with fewer than two units."""
    p_t: float
    """Two-sided p value of the paired t test."""
    p_signed_rank: float
    """Two-sided p value of Wilcoxon's signed-rank test; with n units it cannot be below 2 / 2^n."""
    corrected: float = math.nan
    """``p_t`` corrected for several comparisons; NaN if there is one."""
    n_tests: int = 1
    """Number of comparisons that it is corrected for."""
    failed: dict[str, str] = field(default_factory=dict)
    """Rule without any completed run -> why its first run failed."""

    @property
    def units(self) -> list[float]:
        """What is tested: a difference for each scene, the mean over its seeds; on one scene, one for each seed."""
        return _units(self.differences)

    @property
    def verdict(self) -> Verdict:
        """Which rule is better, or that this cannot be said. ``corrected`` decides where it is known."""
        better = COLUMNS[self.metric].better
        if len(self.units) < 2:
            return "unknown"
        if not any(self.units):
            return "equal"
        p = self.p_t if math.isnan(self.corrected) else self.corrected
        if p >= SIGNIFICANCE or math.isnan(p) or better == "neither":
            return "noise"
        return "a" if (self.mean > 0) == (better == "higher") else "b"

    def __str__(self) -> str:
        column, scenes, n = COLUMNS[self.metric], list(self.differences), len(self.units)
        unit = f" {column.unit}" if column.unit else ""
        if self.failed:
            reasons = "; ".join(f"all runs of {label} failed: {reason}" for label, reason in self.failed.items())
            return f"{self.a} and {self.b}: nothing can be said about noise, because {reasons}"
        if self.verdict == "unknown":
            have = "one run of each" if n else "no pair of completed runs"
            return f"{self.a} and {self.b}: nothing can be said about noise from {have}; use several scenes"
        here, units = ("", f"{n} scenes") if len(scenes) > 1 else (f" on {scenes[0]}", f"{n} seeds")
        if self.verdict == "equal":
            return f"{self.a} and {self.b} have the same {column.heading}{here} in all {units}"
        low, high = map(column.text, self.interval if self.mean >= 0 else (-self.interval[1], -self.interval[0]))
        same_sign = sum(np.sign(d) == np.sign(self.mean) for d in self.units)
        evidence = (
            f"95 % interval {low} to {high}{unit}; same sign in {same_sign} of {units}; t test {p_text(self.p_t)}"
        )
        if self.n_tests > 1:
            evidence += f", corrected for {self.n_tests} comparisons: {p_text(self.corrected)}"
        size = f"{column.text(abs(self.mean))}{unit} {column.heading}"
        end = f"({evidence})" + ("" if len(scenes) > 1 else "; seeds are random draws, and one scene is only one")
        if self.verdict == "noise":
            return f"{self.a} and {self.b} differ by {size}{here}, which is within noise {end}"
        winner, loser = (self.a, self.b) if self.verdict == "a" else (self.b, self.a)
        return f"{winner} is better than {loser} by {size}{here}, which is more than noise {end}"


def compare(
    results: "Iterable[RunResult]", a: str, b: str, *, budget: str | None = None, metric: str = FIRST_METRIC
) -> Comparison:
    """Is the difference between two rules more than noise?

    Each run of rule ``a`` is paired with the run of rule ``b`` that has the same scene, seed and budget. The pairs of a
    scene give one difference, their mean, because seeds change only random draws and share everything else. Student's
    t test and Wilcoxon's signed-rank test (scipy) then have one unit for each scene: they ask whether other scenes of
    this kind would show the same. On a single scene the seeds are the units, and the answer is about its draws only.

    Args:
        results: Runs of the lab; failed runs are left out, together with their partners.
        a, b: Labels of the two rules.
        budget: Only runs with this budget (its text); all by default.
        metric: Name of the number, one of ``COLUMNS``.

    Raises:
        KeyError: a label without any run, or an unknown metric.
    """
    COLUMNS[metric]
    results = list(results)
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
    for place, value in values[a].items():
        if place in values[b]:
            differences.setdefault(place[0], []).append(value - values[b][place])
    d = np.array(_units(differences), float)
    interval, p_t, p_signed_rank = paired_tests(d)
    own = {label: [r for r in chosen if r.spec.label == label] for label in (a, b)}
    return Comparison(
        a=a, b=b, metric=metric, differences=differences, mean=float(d.mean()) if len(d) else math.nan,
        interval=interval, p_t=p_t, p_signed_rank=p_signed_rank,
        failed={x: runs[0].reason for x, runs in own.items() if runs and all(r.status == "failed" for r in runs)},
    )  # fmt: skip


def against_reference(results: "Sequence[RunResult]", budget: str, reference: str = "") -> list[Comparison]:
    """The reference against each other rule at one budget, with p values corrected by Holm's method; empty without it.

    Args:
        results: All runs.
        budget: Text of the budget.
        reference: Label of a rule; by default the first of ``standings``, the best.
    """
    groups = [g for g in group_runs(results) if g.budget == budget]
    labels = [s.label for s in standings(groups) if s.ranks]
    reference = reference or next(iter(labels), "")
    if reference not in labels:
        return []
    return corrected([compare(results, reference, other, budget=budget) for other in labels if other != reference])


def corrected(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """The comparisons with p values corrected by Holm's method for their number."""
    p_values = holm([c.p_t for c in comparisons])
    n_tests = sum(not math.isnan(p) for p in p_values)
    return [replace(c, corrected=p, n_tests=n_tests) for c, p in zip(comparisons, p_values, strict=True)]


def paired_tests(differences: Float[np.ndarray, "N"]) -> tuple[tuple[float, float], float, float]:
    """95 % interval of the mean by Student's t, p of the t test, and p of Wilcoxon's signed-rank test, all of scipy.

    NaN with fewer than two differences. If all differences are the same, the interval is that value, and p of the
    t test is 0, or 1 if the value is zero.
    """
    from scipy import stats

    if len(differences) < 2:
        return (math.nan, math.nan), math.nan, math.nan
    if not differences.any():
        return (0.0, 0.0), 1.0, 1.0
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # about differences that are all the same
        t: Any = stats.ttest_1samp(differences, 0.0)
        interval: Any = t.confidence_interval(0.95)
        signed: Any = stats.wilcoxon(differences)
    return (float(interval.low), float(interval.high)), float(t.pvalue), float(signed.pvalue)


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


def draws_differ(a: Sequence[float], b: Sequence[float], column: Column) -> bool:
    """Whether two rules differ on one scene by more than their random draws explain: Welch's t test over the seeds.

    Never with fewer than two seeds, or if the means are equal in the digits shown.
    """
    from scipy import stats

    if min(len(a), len(b)) < 2 or column.shown(float(np.mean(a))) == column.shown(float(np.mean(b))):
        return False
    if np.ptp(a) == np.ptp(b) == 0:
        return True
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        test: Any = stats.ttest_ind(a, b, equal_var=False)
    return bool(test.pvalue < SIGNIFICANCE)


def p_text(p: float) -> str:
    """A p value as text: "p = 0.032", "p < 0.001"."""
    return "p unknown" if math.isnan(p) else "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def _units(differences: dict[str, list[float]]) -> list[float]:
    if len(differences) == 1:
        return list(next(iter(differences.values())))
    return [float(np.mean(of_scene)) for of_scene in differences.values()]
