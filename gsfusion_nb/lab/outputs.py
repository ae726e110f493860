"""The files that the lab writes about its runs: tables, Pareto figures, and the page."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..files import atomic_file, write_file
from .best_rule import against_the_best, comparison_sentence
from .page import page_html
from .result import RunResult
from .result_table import ResultTable, failures, rank_table, scene_table
from .scene_plots import figure_of
from .statistics import by_budget, group_runs
from .table_text import as_markdown, latex_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_outputs(folder: Path | str, results: Iterable[RunResult]) -> list[Path]:
    """Write ``table.md``, ``table.tex``, ``pareto.pdf``, ``pareto.png`` and ``page.html`` about these runs.

    Existing files are replaced, each completely or not at all; so it can be called again after every run.

    Args:
        folder: Where the files go; the names in ``RunResult.pictures`` are looked up there.
        results: All runs, also those that failed. The order of the rules, scenes and budgets is kept.

    Returns:
        The files written.
    """
    folder, results = Path(folder), list(results)
    tables = all_tables(results)
    texts = {
        "table.md": markdown_file(results, tables),
        "table.tex": latex_file(tables),
        "page.html": page_html(folder, results),
    }
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


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a figure as PDF or PNG, without a date, so that equal figures are equal files."""
    import matplotlib

    options: dict[str, Any] = {"metadata": {"CreationDate": None}} if path.suffix == ".pdf" else {"dpi": 150}
    with matplotlib.rc_context({"pdf.fonttype": 42}), atomic_file(path) as temporary:
        figure.savefig(temporary, **options)
