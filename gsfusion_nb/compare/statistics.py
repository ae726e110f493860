"""What several runs say together: the numbers shown, means and spreads, ranks."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from ..evaluation.metrics import METRICS
from .scene_units import scene_units

if TYPE_CHECKING:
    from .run_result import RunResult

Better = Literal["higher", "lower", "neither"]


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
    """All columns, in the order of the tables: names, units and digits are those of ``METRICS``
    where it has them."""
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
    yield Column(
        metric="ms_per_frame", heading="Time per frame", unit="ms", digits=1, better="lower"
    )
    yield Column(
        metric="cpu_ms_per_frame", heading="CPU time per frame", unit="ms", digits=1, better="lower"
    )
    yield Column(
        metric="seeding_ms", heading="Seeding per frame", unit="ms", digits=1, better="lower"
    )
    yield _column("seconds_total", "lower")
    yield _column("peak_memory_mb", "lower", "Memory")
    for metric in ("fps_total", "fps_mapping", "fps_tracking"):
        yield _column(metric, "higher")


def _column(metric: str, better: Better, heading: str = "") -> Column:
    metric_of_run = METRICS[metric]
    return Column(
        metric=metric,
        heading=heading or metric_of_run.label,
        unit=metric_of_run.unit,
        digits=metric_of_run.digits,
        scale=metric_of_run.scale,
        better=better,
    )


COLUMNS: Mapping[str, Column] = {column.metric: column for column in _columns()}
"""Name of a number -> its column, in the order of the tables."""

FIRST_METRIC = "psnr_held_out_db"
"""The number that rules are ranked and compared by, unless another one is asked for."""


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
    numbers = np.array([v for v in values if not math.isnan(v)], float)
    if len(numbers) == 0:
        return Summary(math.nan, math.nan, 0)
    has_spread = len(numbers) > 1 and bool(np.isfinite(numbers).all())
    return Summary(
        float(numbers.mean()),
        float(numbers.std(ddof=1)) if has_spread else math.nan,
        len(numbers),
    )


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
        """Whether the budget gives every rule the same size, so that differences are left-overs of
        the tuning."""
        return any(run.spec.budget.gaussians is not None for run in (*self.runs, *self.failed))

    def summary(self, metric: str) -> Summary:
        """Over the completed runs; a run without this number does not count."""
        return summarise(run.metrics.get(metric, math.nan) for run in self.runs)


def group_runs(results: "Iterable[RunResult]") -> list[Group]:
    """Runs by label, scene and budget, in the order in which these were first seen."""
    runs_of: dict[tuple[str, str, str], tuple[list[RunResult], list[RunResult]]] = {}
    for result in results:
        spec = result.spec
        complete, failures = runs_of.setdefault(
            (spec.label, spec.scene, str(spec.budget)),
            ([], []),
        )
        (complete if result.status == "done" else failures).append(result)
    return [
        Group(
            label=label,
            scene=scene,
            budget=budget,
            runs=tuple(complete),
            failed=tuple(failures),
        )
        for (label, scene, budget), (complete, failures) in runs_of.items()
    ]


def by_budget(groups: Sequence[Group]) -> list[list[Group]]:
    """The groups of each budget."""
    return [
        [g for g in groups if g.budget == budget]
        for budget in dict.fromkeys(g.budget for g in groups)
    ]


def over_units(
    by_scene: Mapping[str, float],
    units: Mapping[str, str],
) -> list[float]:
    """Means over the scenes of each unit, of those in ``by_scene``; NaN where one of them is
    NaN."""
    of_unit: dict[str, list[float]] = {}
    for scene, value in by_scene.items():
        of_unit.setdefault(units.get(scene, scene), []).append(value)
    return [float(np.mean(values)) for values in of_unit.values()]


def unit_means(
    groups: Sequence[Group], metric: str, units: Mapping[str, str]
) -> tuple[list[str], np.ndarray]:
    """The rules of one budget, and the mean of each on each unit; NaN where it lacks a scene of it.
    [rules, units]"""
    scenes = list(dict.fromkeys(group.scene for group in groups))
    labels = list(dict.fromkeys(group.label for group in groups))
    means = {(group.label, group.scene): group.summary(metric).mean for group in groups}
    rows = [
        over_units(
            {s: means.get((label, s), math.nan) for s in scenes},
            units,
        )
        for label in labels
    ]
    return labels, np.array(rows, float).reshape(
        len(labels), len({units.get(s, s) for s in scenes})
    )


@dataclass(frozen=True, kw_only=True)
class Standing:
    """One rule over all scenes of a comparison, at one budget; NaN if it has no result on one of
    them."""

    label: str
    rank: float
    """Mean over the scenes of the rank by the mean over seeds, 1 is best; ties share the mean of
    their ranks."""
    over_scenes: Summary
    """Of the means of the scenes. Scenes that share frames count as one, with the mean over
    them."""


def standings(
    groups: Sequence[Group],
    units: Mapping[str, str] | None = None,
) -> list[Standing]:
    """The rules of one budget, best mean of ``FIRST_METRIC`` over the scenes first; incomplete ones
    come last.

    Means that are equal in the digits of the tables share a rank.

    Args:
        groups: Of one budget.
        units: ``scene_units`` of all runs; of those of ``groups`` if None.
    """
    from scipy.stats import rankdata

    units = scene_units(run for group in groups for run in group.runs) if units is None else units
    labels, means = unit_means(groups, FIRST_METRIC, units)
    rounded_means = np.vectorize(COLUMNS[FIRST_METRIC].shown, otypes=[float])(means)
    ranks = rankdata(-rounded_means, axis=0, nan_policy="omit").mean(axis=1) if labels else ()
    nothing = Summary(math.nan, math.nan, 0)
    standing = [
        Standing(
            label=label,
            rank=float(rank),
            over_scenes=nothing if math.isnan(rank) else summarise(own),
        )
        for label, rank, own in zip(labels, ranks, means.tolist(), strict=True)
    ]
    return sorted(
        standing,
        key=lambda s: (math.isnan(s.over_scenes.mean), -s.over_scenes.mean),
    )
