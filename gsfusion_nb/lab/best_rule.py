"""Is the best rule better than each other one by more than noise?"""

from collections.abc import Sequence

from .columns import FIRST_METRIC
from .paired_tests import SIGNIFICANCE, Comparison, compare, holm, p_text
from .result import RunResult
from .statistics import group_runs, summarise


def against_the_best(results: Sequence[RunResult], budget: str) -> list[tuple[Comparison, float]]:
    """The rule with the best mean over the scenes against each other one, with p values corrected by Holm's method."""
    groups = [g for g in group_runs(results) if g.budget == budget and g.summary(FIRST_METRIC).n]
    labels = list(dict.fromkeys(g.label for g in groups))
    scenes = {label: {g.scene for g in groups if g.label == label} for label in labels}
    everywhere = [label for label in labels if len(scenes[label]) == max(map(len, scenes.values()))]
    means = {
        label: summarise(g.summary(FIRST_METRIC).mean for g in groups if g.label == label).mean for label in everywhere
    }
    if len(labels) < 2:
        return []
    best = max(means, key=lambda label: means[label])
    comparisons = [compare(results, best, other, budget=budget) for other in labels if other != best]
    return list(zip(comparisons, holm([c.p_t for c in comparisons]), strict=True))


def comparison_sentence(comparison: Comparison, corrected: float, n_tests: int) -> str:
    """A comparison in words; with several tests also its corrected p value, and what changes with it."""
    text = str(comparison)
    if n_tests < 2 or comparison.verdict not in ("a", "b", "noise"):
        return text
    text += f"; corrected for {n_tests} comparisons: {p_text(corrected)}"
    lost = comparison.verdict != "noise" and corrected >= SIGNIFICANCE
    return f"{text}, so it may be noise after all" if lost else text
