"""The ranks of all rules at once: the tests of Friedman (SciPy) and Nemenyi (scikit-posthocs)."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .paired_tests import SIGNIFICANCE, p_text
from .scene_units import scene_units
from .statistics import COLUMNS, FIRST_METRIC, group_runs, unit_means

if TYPE_CHECKING:
    from .run_result import RunResult


@dataclass(frozen=True, kw_only=True)
class RankTest:
    """The ranks of all rules at one budget: Friedman's test, and Nemenyi's for each pair;
    ``sentences`` says it."""

    labels: tuple[str, ...]
    """The rules with a result on every scene, best mean rank first."""
    left_out: tuple[str, ...]
    """The others."""
    ranks: tuple[float, ...]
    """Mean rank of each of ``labels`` over the units, 1 is best."""
    n_units: int
    p: float
    """Of Friedman's test that all rules are equal; NaN with fewer than three rules or two units."""
    pairs: Mapping[tuple[str, str], float]
    """The better and the worse rule -> p of Nemenyi's test, which counts all pairs; empty where
    ``p`` is NaN."""

    @property
    def better(self) -> list[tuple[str, str]]:
        """The pairs that differ by more than noise, the better rule first: none unless Friedman's
        test sees a difference."""
        return [
            pair for pair, p in self.pairs.items() if self.p < SIGNIFICANCE and p < SIGNIFICANCE
        ]

    @property
    def sentences(self) -> list[str]:
        """What the tests say: about all rules, then about each pair that differs by more than
        noise."""
        size = f"{len(self.labels)} rules on {self.n_units} scene{'s' * (self.n_units > 1)}"
        lines = [
            f"{label} has no result on some scenes, so it has no rank" for label in self.left_out
        ]
        if math.isnan(self.p):
            return [
                f"nothing can be said about the ranks of {size}; Friedman's test needs 3 rules and "
                "2 scenes",
                *lines,
            ]
        conclusion = (
            "they are not all equal"
            if self.p < SIGNIFICANCE
            else "which is within noise, so no pair is tested"
        )
        lines.insert(0, f"Friedman's test of {size}: {p_text(self.p)}, {conclusion}")
        rank = dict(zip(self.labels, self.ranks, strict=True))
        for a, b in self.better:
            lines.append(
                f"{a} is better than {b}: mean ranks {rank[a]:.2f} and {rank[b]:.2f}, which is "
                f"more than noise (Nemenyi's test for all pairs: {p_text(self.pairs[a, b])})"
            )
        if self.p < SIGNIFICANCE:
            n_left = len(self.pairs) - len(self.better)
            lines.append(f"{n_left} of {len(self.pairs)} pairs differ by no more than noise")
        return lines


def rank_test(results: "Sequence[RunResult]", budget: str, metric: str = FIRST_METRIC) -> RankTest:
    """Friedman's test (scipy) over the units of a budget, and Nemenyi's (scikit-posthocs), of rules
    with all results.

    Demsar, Statistical Comparisons of Classifiers over Multiple Data Sets, JMLR 2006, Sections
    3.2.2 and 3.2.3.
    """
    from scipy.stats import friedmanchisquare, rankdata

    groups = [group for group in group_runs(results) if group.budget == budget]
    labels, means = unit_means(groups, metric, scene_units(results))
    is_complete: Any = np.isfinite(means).all(axis=1)
    sign = -1.0 if COLUMNS[metric].better == "higher" else 1.0
    ranks = rankdata(sign * means[is_complete], axis=0)
    order = np.argsort(ranks.mean(axis=1), kind="stable") if len(ranks) else np.zeros(0, int)
    complete_labels = [
        label for label, complete in zip(labels, is_complete, strict=True) if complete
    ]
    ranking = RankTest(
        labels=tuple(complete_labels[i] for i in order),
        ranks=tuple(ranks.mean(axis=1)[order].tolist()),
        left_out=tuple(label for label in labels if label not in complete_labels),
        n_units=means.shape[1],
        p=math.nan,
        pairs={},
    )
    if len(complete_labels) < 3 or means.shape[1] < 2 or not np.ptp(ranks):
        return ranking
    import scikit_posthocs

    rows = ranks[order]
    p: Any = scikit_posthocs.posthoc_nemenyi_friedman(rows.T)
    both = itertools.combinations(range(len(rows)), 2)
    pairs = {(ranking.labels[i], ranking.labels[j]): float(p.iloc[i, j]) for i, j in both}
    return replace(ranking, p=float(friedmanchisquare(*rows).pvalue), pairs=pairs)
