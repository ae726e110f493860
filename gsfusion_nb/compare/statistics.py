"""What several runs say together: the numbers shown, means and spreads, ranks, paired tests over scenes."""

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ..evaluation.metrics import METRICS
from .scene_units import scene_units

if TYPE_CHECKING:
    from .spec import RunResult

Better = Literal["higher", "lower", "neither"]
Verdict = Literal["a", "b", "noise", "equal", "unknown"]


@dataclass(frozen=True, kw_only=True)
class Column:
    """One number of a run, as the tables show it."""

    metric: str
    """Name in ``RunResult.metrics``."""
    heading: str
    unit: str = ""
    digits: int = 2
    scale: float = 1.0
    """Factor from the stored unit to the shown one."""
    better: Better = "neither"

    @property
    def name(self) -> str:
        """Heading and unit in one text: "PSNR held out, dB"."""
        return f"{self.heading}, {self.unit}" if self.unit else self.heading

    def shown(self, value: float) -> float:
        """A value in the unit of the table, rounded to the digits that are shown."""
        return round(value * self.scale, self.digits)

    def text(self, value: float) -> str:
        """A value as text, without its unit; "–" for NaN."""
        number = self.shown(value)
        if number != number:
            return "–"
        return "∞" if number == float("inf") else f"{number:,.{self.digits}f}"


def _columns() -> Iterator[Column]:
    """All columns, in the order of the tables: names, units and digits are those of ``METRICS`` where it has them."""
    views = {"held_out": "held out", "held_out_between": "between neighbours", "mapped": "mapped"}
    images: dict[str, Better] = {"psnr_{}_db": "higher", "ssim_{}": "higher", "lpips_{}": "lower"}
    images["depth_l1_{}_m"] = "lower"
    for name, better in images.items():
        for group, words in views.items():
            metric = name.format(group)
            yield _column(metric, better, f"{METRICS[metric].label} {words}")
    yield _column("psnr_held_out_online_db", "higher", "PSNR online held out")
    yield _column("psnr_mapped_online_db", "higher", "PSNR online mapped")
    yield _column("ssim_held_out_online", "higher", "SSIM online held out")
    yield _column("mesh_accuracy_m", "lower", "Mesh accuracy")
    yield _column("mesh_completion_m", "lower", "Mesh completion")
    yield _column("mesh_psnr_held_out_db", "higher", "Mesh PSNR held out")
    yield _column("ate_rmse_m", "lower")
    yield _column("drift_m", "lower")
    yield _column("n_gaussians", "lower")
    yield _column("n_keyframes", "neither")
    yield Column(metric="n_steps", heading="Gradient steps", digits=0)
    yield Column(metric="ms_per_frame", heading="Time per frame", unit="ms", digits=1, better="lower")
    yield Column(metric="cpu_ms_per_frame", heading="CPU time per frame", unit="ms", digits=1, better="lower")
    yield Column(metric="seeding_ms", heading="Seeding per frame", unit="ms", digits=1, better="lower")
    yield _column("seconds_total", "lower")
    yield _column("peak_memory_mb", "lower", "Memory")
    for metric in ("fps_total", "fps_mapping", "fps_tracking"):
        yield _column(metric, "higher")


def _column(metric: str, better: Better, heading: str = "") -> Column:
    known = METRICS[metric]
    return Column(metric=metric, heading=heading or known.label, unit=known.unit, digits=known.digits,
                  scale=known.scale, better=better)  # fmt: skip


COLUMNS: Mapping[str, Column] = {column.metric: column for column in _columns()}
"""Name of a number -> its column, in the order of the tables."""

FIRST_METRIC = "psnr_held_out_db"
"""The number that rules are ranked and compared by, unless another one is asked for."""
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
    def fixes_size(self) -> bool:
        """Whether the budget gives every rule the same size, so that differences are left-overs of the tuning."""
        return any(run.spec.budget.gaussians is not None for run in (*self.runs, *self.failed))

    def summary(self, metric: str) -> Summary:
        """Over the completed runs; a run without this number does not count."""
        return summarise(run.metrics.get(metric, math.nan) for run in self.runs)


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


def over_units(by_scene: Mapping[str, float], units: Mapping[str, str]) -> list[float]:
    """Means over the scenes of each unit, of those in ``by_scene``; NaN where one of them is NaN."""
    of_unit: dict[str, list[float]] = {}
    for scene, value in by_scene.items():
        of_unit.setdefault(units.get(scene, scene), []).append(value)
    return [float(np.mean(values)) for values in of_unit.values()]


@dataclass(frozen=True, kw_only=True)
class Standing:
    """One rule over all scenes of a comparison, at one budget; NaN if it has no result on one of them."""

    label: str
    rank: float
    """Mean over the scenes of the rank by the mean over seeds, 1 is best; ties share the mean of their ranks."""
    over_scenes: Summary
    """Of the means of the scenes. Scenes that share frames count as one, with the mean over them."""


def standings(groups: Sequence[Group], units: Mapping[str, str] | None = None) -> list[Standing]:
    """The rules of one budget, best mean of ``FIRST_METRIC`` over the scenes first; incomplete ones come last.

    Means that are equal in the digits of the tables share a rank.

    Args:
        groups: Of one budget.
        units: ``scene_units`` of all runs; of those of ``groups`` if None.
    """
    from scipy.stats import rankdata

    units = scene_units(run for group in groups for run in group.runs) if units is None else units
    column, scenes = COLUMNS[FIRST_METRIC], list(dict.fromkeys(group.scene for group in groups))
    labels = list(dict.fromkeys(group.label for group in groups))
    found = {(group.label, group.scene): group.summary(FIRST_METRIC).mean for group in groups}
    rows = [over_units({s: found.get((label, s), math.nan) for s in scenes}, units) for label in labels]
    means = np.array(rows).reshape(len(labels), -1)
    shown = np.vectorize(column.shown, otypes=[float])(means)
    ranks = rankdata(-shown, axis=0, nan_policy="omit").mean(axis=1) if labels else ()
    nothing = Summary(math.nan, math.nan, 0)
    standing = [
        Standing(label=label, rank=float(rank), over_scenes=nothing if math.isnan(rank) else summarise(own))
        for label, rank, own in zip(labels, ranks, means.tolist(), strict=True)
    ]
    return sorted(standing, key=lambda s: (math.isnan(s.over_scenes.mean), -s.over_scenes.mean))


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The paired comparison of two rules, "a" and "b"; differences are a - b.

    ``str`` says it in words. All numbers are in the unit of the metric.
    """

    a: str
    b: str
    metric: str
    differences: dict[str, list[float]]
    """Unit (a scene, or several that share frames) -> difference of each pair of runs with the same seed and budget,
    the mean over the unit's scenes. On a single unit pairs whose maps are equal to those of an earlier one are left
    out: they are the same observation."""
    n_pairs: int
    """Number of pairs of runs."""
    n_scenes: int
    """Number of scenes that they are on."""
    mean: float
    """Mean over the units; NaN without a pair."""
    interval: tuple[float, float]
    """95 % confidence interval of the mean difference by Student's t; NaN with fewer than two units."""
    p: float
    """Two-sided p value of the paired t test."""
    corrected: float = math.nan
    """``p`` corrected for several comparisons; NaN if there is one."""
    n_tests: int = 1
    """Number of comparisons that it is corrected for."""

    @property
    def units(self) -> list[float]:
        """What is tested: a difference for each unit, the mean over its seeds; on a single one, one for each seed."""
        return _units(self.differences)

    @property
    def verdict(self) -> Verdict:
        """Which rule is better, or that this cannot be said. ``corrected`` decides where it is known."""
        better = COLUMNS[self.metric].better
        if len(self.units) < 2:
            return "unknown"
        if not any(self.units):
            return "equal"
        p = self.p if math.isnan(self.corrected) else self.corrected
        if p >= SIGNIFICANCE or math.isnan(p) or better == "neither":
            return "noise"
        return "a" if (self.mean > 0) == (better == "higher") else "b"

    def __str__(self) -> str:
        column = COLUMNS[self.metric]
        if self.verdict == "unknown":
            return f"{self.a} and {self.b}: nothing can be said about noise from {self._pairs()}; use several scenes"
        if self.verdict == "equal":
            return f"{self.a} and {self.b} have the same {column.heading} in {self._pairs()}"
        unit = f" {column.unit}" if column.unit else ""
        low, high = map(column.text, self.interval if self.mean >= 0 else (-self.interval[1], -self.interval[0]))
        evidence = f"95 % interval {low} to {high}{unit}; {self._pairs()}; paired t test: {p_text(self.p)}"
        if self.n_tests > 1:
            evidence += f", corrected for {self.n_tests} comparisons: {p_text(self.corrected)}"
        size = f"{column.text(abs(self.mean))}{unit} {column.heading}"
        if self.verdict == "noise":
            return f"{self.a} and {self.b} differ by {size}, which is within noise ({evidence})"
        winner, loser = (self.a, self.b) if self.verdict == "a" else (self.b, self.a)
        return f"{winner} is better than {loser} by {size}, which is more than noise ({evidence})"

    def _pairs(self) -> str:
        """How many pairs of runs there are, and why they count as fewer."""
        n_units, seeds = len(self.differences), sum(map(len, self.differences.values()))
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

    Each run of rule ``a`` is paired with the run of rule ``b`` that has the same scene, seed and budget. The pairs of a
    scene give one difference, their mean, because seeds change only random draws and share everything else. Scenes that
    share frames give one together. Student's paired t test (scipy) then has one unit for each scene: it asks whether
    other scenes of this kind would show the same. On a single scene the seeds are the units, and the answer is about
    its draws only.

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
        spec, value = result.spec, result.metrics.get(metric, math.nan)
        own = of_label.setdefault(spec.label, {})
        if math.isfinite(value) and budget in (None, str(spec.budget)):
            own[spec.scene, str(spec.budget), spec.seed] = result
    for label in (a, b):
        if label not in of_label:
            raise KeyError(f"no runs of {label!r}; there are: {', '.join(sorted(of_label)) or 'none'}")
    pairs = {place: (of_a, of_label[b][place]) for place, of_a in of_label[a].items() if place in of_label[b]}
    differences = _differences(pairs, metric, units)
    observed = _units(differences)
    interval, p = paired_test(observed)
    return Comparison(
        a=a, b=b, metric=metric, differences=differences, n_pairs=len(pairs), n_scenes=len({s for s, _, _ in pairs}),
        mean=float(np.mean(observed)) if observed else math.nan, interval=interval, p=p,
    )  # fmt: skip


def _differences(
    pairs: "Mapping[tuple[str, str, int], tuple[RunResult, RunResult]]", metric: str, units: Mapping[str, str]
) -> dict[str, list[float]]:
    """``Comparison.differences`` from the pair of runs of each scene, budget and seed."""
    by_unit: dict[str, dict[tuple[str, int], list[tuple[RunResult, RunResult]]]] = {}
    for (scene, budget, seed), pair in pairs.items():
        by_unit.setdefault(units.get(scene, scene), {}).setdefault((budget, seed), []).append(pair)
    found: dict[str, list[float]] = {}
    for unit, by_seed in by_unit.items():
        of_maps: dict[Any, float] = {}
        for place, of_scenes in by_seed.items():
            hashes = tuple((x.spec.scene, x.map_hash, y.map_hash) for x, y in of_scenes)
            is_known = len(by_unit) == 1 and all(x and y for _, x, y in hashes)
            difference = float(np.mean([x.metrics[metric] - y.metrics[metric] for x, y in of_scenes]))
            of_maps.setdefault((place[0], hashes) if is_known else place, difference)
        found[unit] = list(of_maps.values())
    return found


def against_reference(results: "Sequence[RunResult]", budget: str, reference: str = "") -> list[Comparison]:
    """The reference against each other rule at one budget, with p values corrected by Holm's method; empty without it.

    Args:
        results: All runs.
        budget: Text of the budget.
        reference: Label of a rule; by default the first of ``standings``, the best.
    """
    units = scene_units(results)
    groups = [g for g in group_runs(results) if g.budget == budget]
    labels = [s.label for s in standings(groups, units) if any(g.runs for g in groups if g.label == s.label)]
    reference = reference or next(iter(labels), "")
    if reference not in labels:
        return []
    others = [label for label in labels if label != reference]
    return corrected([compare(results, reference, other, budget=budget, units=units) for other in others])


def corrected(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """The comparisons with p values corrected for their number by the step-down method of Holm (1979).

    A NaN is a test that could not be made: it stays NaN and is not counted.
    """
    known = sorted((c for c in comparisons if not math.isnan(c.p)), key=lambda c: c.p)
    found, largest = {}, 0.0
    for position, c in enumerate(known):
        largest = max(largest, min(1.0, (len(known) - position) * c.p))
        found[id(c)] = largest
    return [replace(c, corrected=found.get(id(c), math.nan), n_tests=len(known)) for c in comparisons]


def paired_test(differences: Sequence[float]) -> tuple[tuple[float, float], float]:
    """95 % interval of the mean by Student's t, and p of the paired t test, both of scipy.

    NaN with fewer than two differences. If all differences are the same, the interval is that value, and p is 0, or 1
    if the value is zero.
    """
    from scipy import stats

    if len(differences) < 2:
        return (math.nan, math.nan), math.nan
    if not any(differences):
        return (0.0, 0.0), 1.0
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # about differences that are all the same
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
