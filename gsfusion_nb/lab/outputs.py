"""The files that the lab writes about its runs: tables, Pareto figures, and the page."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..files import atomic_file, write_file
from .columns import COLUMNS, FIRST_METRIC
from .paired_tests import SIGNIFICANCE, Comparison, compare, holm, p_text
from .pareto import ParetoPoints, pareto_figure
from .result import RunResult
from .result_table import ResultTable, failures, rank_table, scene_table
from .statistics import Group, group_runs, summarise
from .table_text import as_markdown, latex_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COSTS = {"n_gaussians": "Gaussians (fewer is better)", "ms_per_frame": "time per frame, ms (less is better)"}
"""Costs of the Pareto figure."""


def write_outputs(folder: Path | str, results: Iterable[RunResult]) -> list[Path]:
    """Write ``table.md``, ``table.tex``, ``pareto.pdf`` and ``pareto.png`` about these runs.

    Existing files are replaced, each completely or not at all; so it can be called again after every run.

    Args:
        folder: Where the files go; the names in ``RunResult.pictures`` are looked up there.
        results: All runs, also those that failed. The order of the rules, scenes and budgets is kept.

    Returns:
        The files written.
    """
    folder, results = Path(folder), list(results)
    tables = all_tables(results)
    texts = {"table.md": markdown_file(results, tables), "table.tex": latex_file(tables)}
    for name, text in texts.items():
        write_file(folder / name, text)
    figure = figure_of(results)
    save_figure(figure, folder / "pareto.pdf")
    save_figure(figure, folder / "pareto.png")
    return [folder / name for name in (*texts, "pareto.pdf", "pareto.png")]


def all_tables(results: Iterable[RunResult]) -> list[ResultTable]:
    """For each budget: a table of each scene, and the ranks over the scenes if there are several."""
    tables = []
    for of_budget in by_budget(group_runs(results)):
        scenes = list(dict.fromkeys(group.scene for group in of_budget))
        tables += [scene_table([g for g in of_budget if g.scene == scene]) for scene in scenes]
        tables += [rank_table(of_budget)] if len(scenes) > 1 else []
    return tables


def by_budget(groups: Sequence[Group]) -> list[list[Group]]:
    """The groups of each budget."""
    return [[g for g in groups if g.budget == budget] for budget in dict.fromkeys(g.budget for g in groups)]


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
    text += f"; corrected for {n_tests} comparisons: p = {p_text(corrected)}"
    lost = comparison.verdict != "noise" and corrected >= SIGNIFICANCE
    return f"{text}, so it may be noise after all" if lost else text


def markdown_file(results: Sequence[RunResult], tables: Iterable[ResultTable]) -> str:
    """All tables, the comparisons with the best rule, and the runs that failed."""
    parts = ["# Results", *map(as_markdown, tables)]
    for budget in dict.fromkeys(str(r.spec.budget) for r in results):
        pairs = against_the_best(results, budget)
        if pairs:
            lines = [f"- {comparison_sentence(c, p, len(pairs))}" for c, p in pairs]
            parts.append("\n".join([f"### More than noise? {budget}", "", *lines]))
    lost = failures(results)
    if lost:
        lines = [f"- {label}, {scene}, {budget}, seed {seed}: {reason}" for label, scene, budget, seed, reason in lost]
        parts.append("\n".join(["### Runs that failed", "", *lines]))
    return "\n\n".join(parts) + "\n"


def scene_points(groups: Sequence[Group], cost: str, quality: str = FIRST_METRIC) -> ParetoPoints:
    """The rules of one scene, at all budgets, as points with error bars; groups without a number are left out."""
    found = [(g, g.summary(cost), g.summary(quality)) for g in groups]
    found = [(g, c, q) for g, c, q in found if c.n and np.isfinite(q.mean) and c.mean > 0]
    column = COLUMNS[quality]
    return ParetoPoints(
        names=[g.label for g, _, _ in found],
        cost=np.array([c.mean for _, c, _ in found]),
        quality=np.array([q.mean for _, _, q in found]) * column.scale,
        cost_sd=np.array([c.sd for _, c, _ in found]),
        quality_sd=np.array([q.sd for _, _, q in found]) * column.scale,
        title=groups[0].scene,
        cost_label=COSTS.get(cost, COLUMNS[cost].name),
        quality_label=column.name,
    )


def figure_of(results: Iterable[RunResult]) -> "Figure":
    """Held-out PSNR over each of ``COSTS`` on each scene; error bars: standard deviation over seeds."""
    groups = group_runs(results)
    scenes = [[g for g in groups if g.scene == scene] for scene in dict.fromkeys(g.scene for g in groups)]
    plots = [scene_points(of_scene, cost) for of_scene in scenes for cost in COSTS]
    return pareto_figure(*(plots or [ParetoPoints(names=[], cost=np.zeros(0), quality=np.zeros(0))]))


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a figure as PDF or PNG, without a date, so that equal figures are equal files."""
    import matplotlib

    options = {"metadata": {"CreationDate": None}} if path.suffix == ".pdf" else {"dpi": 150}
    with matplotlib.rc_context({"pdf.fonttype": 42}), atomic_file(path) as temporary:
        figure.savefig(temporary, **options)
