"""What several runs say together: mean and spread over seeds, and ranks over scenes."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .columns import COLUMNS, FIRST_METRIC

if TYPE_CHECKING:
    from .result import RunResult


@dataclass(frozen=True)
class Summary:
    """Mean and spread of one number over the runs of a group."""

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


@dataclass(frozen=True, kw_only=True)
class Ranks:
    """The places of one rule."""

    by_scene: dict[str, float]
    """Scene -> rank by the mean over seeds, 1 is best; ties share the mean of their ranks."""
    mean: float
    """Mean over the scenes; NaN if the rule has no result on one of them."""


def rank_rules(groups: Sequence[Group], *, metric: str = FIRST_METRIC) -> dict[str, Ranks]:
    """Ranks of the rules of one budget on each scene, and their mean over the scenes; best mean rank first.

    Means that are equal in the digits of the tables are ties.

    Raises:
        ValueError: groups of several budgets, or a metric without a better direction.
    """
    from scipy.stats import rankdata

    column = COLUMNS[metric]
    if column.better == "neither":
        raise ValueError(f"rules cannot be ranked by {metric}: neither direction is better")
    if len({group.budget for group in groups}) > 1:
        raise ValueError("ranks compare rules at one budget; give the groups of one budget")
    scenes = list(dict.fromkeys(group.scene for group in groups))
    ranks: dict[str, dict[str, float]] = {group.label: {} for group in groups}
    for scene in scenes:
        means = {g.label: g.summary(metric).mean for g in groups if g.scene == scene}
        means = {label: column.shown(mean) for label, mean in means.items() if not math.isnan(mean)}
        sign = -1.0 if column.better == "higher" else 1.0
        for label, rank in zip(means, rankdata([sign * m for m in means.values()]).tolist(), strict=True):
            ranks[label][scene] = float(rank)
    found = {
        label: Ranks(by_scene=by, mean=sum(by.values()) / len(by) if len(by) == len(scenes) else math.nan)
        for label, by in ranks.items()
    }
    return dict(sorted(found.items(), key=lambda item: (math.isnan(item[1].mean), item[1].mean)))
