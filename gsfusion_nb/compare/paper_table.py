"""The table that a paper prints: a row of each scene and method, and of the means, with the best of
a column bold where the test says that it is better.

It is written as LaTeX (package booktabs), CSV and Markdown.
"""

import csv
import dataclasses
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..files import plain_cell
from .markdown import plain_markdown
from .paired_tests import TESTS, Comparison, against_reference, all_pairs, named_reference
from .rank_test import rank_test
from .scene_units import scene_units
from .statistics import (
    COLUMNS,
    FIRST_METRIC,
    Column,
    Group,
    by_budget,
    group_runs,
    over_units,
    summarise,
)
from .tables import Cell

if TYPE_CHECKING:
    from .run_result import RunResult

METRICS = {
    "psnr_{}_db": "PSNR",
    "ssim_{}": "SSIM",
    "lpips_{}": "LPIPS",
    "depth_l1_{}_m": "Depth error",
    "mesh_accuracy_m": "Accuracy",
    "mesh_completion_m": "Completion",
    "ate_rmse_m": "ATE",
    "n_gaussians": "Gaussians",
    "fps_mapping": "Speed",
    "peak_memory_mb": "Memory",
}
"""The columns, with {} for the group of views, and their headings, which are short; those that no
run has are left out."""

MEAN = "mean"
"""Stands for the name of a scene in the rows of the means."""

_ARROWS = {"higher": " ↑", "lower": " ↓", "neither": ""}

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        **{sign: f"\\{sign}" for sign in "&%$#_{}"},
        "±": r"$\pm$",
        "↑": r"$\uparrow$",
        "↓": r"$\downarrow$",
        "∞": r"$\infty$",
        "–": "--",
        "†": r"$^\dagger$",
    }
)


@dataclass(frozen=True, kw_only=True)
class PaperRow:
    """A method on a scene."""

    scene: str
    label: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True, kw_only=True)
class PaperTable:
    """A table of a paper."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[PaperRow, ...]
    """Those of a scene one after the other."""
    notes: tuple[str, ...] = ()
    """Sentences that belong to the table."""
    first_heading: str = "Scene"
    """Heading of ``PaperRow.scene``."""

    @property
    def headings(self) -> tuple[str, ...]:
        """Names and units of the columns, with an arrow to the better values."""
        return tuple(f"{column.name}{_ARROWS[column.better]}" for column in self.columns)

    def as_latex(self) -> str:
        r"""A ``table`` for LaTeX, which needs ``\usepackage{booktabs}``; the notes are comments."""
        lines = []
        last_scene = ""
        for row in self.rows:
            if lines and row.scene != last_scene:
                lines.append(r"\midrule")
            scene = row.scene if row.scene != last_scene else ""
            cells = (
                rf"\textbf{{{latex_text(c.text)}}}" if c.best else latex_text(c.text)
                for c in row.cells
            )
            lines.append(rf"{' & '.join([latex_text(scene), latex_text(row.label), *cells])} \\")
            last_scene = row.scene
        heads = " & ".join(map(latex_text, (self.first_heading, "Method", *self.headings)))
        notes = (f"% {' '.join(note.split())}" for note in self.notes)
        return "\n".join(
            [
                r"% \usepackage{booktabs}",
                *notes,
                r"\begin{table}",
                r"\centering\small\setlength{\tabcolsep}{4pt}",
                rf"\caption{{{latex_text(self.title)}}}",
                rf"\begin{{tabular}}{{ll{'r' * len(self.columns)}}}",
                r"\toprule",
                rf"{heads} \\",
                r"\midrule",
                *lines,
                r"\bottomrule",
                r"\end{tabular}",
                r"\end{table}",
                "",
            ]
        )

    def as_markdown(self) -> str:
        """A heading, the table and its notes."""
        lines = [
            f"### {plain_markdown(self.title)}",
            "",
            f"| {' | '.join(map(plain_markdown, ('scene', 'method', *self.headings)))} |",
            "|---|---|" + "---:|" * len(self.columns),
        ]
        for row in self.rows:
            names = map(plain_markdown, (row.scene, row.label))
            cells = (
                f"**{plain_markdown(c.text)}**" if c.best else plain_markdown(c.text)
                for c in row.cells
            )
            lines.append(f"| {' | '.join([*names, *cells])} |")
        return "\n".join([*lines, "", *(f"- {plain_markdown(note)}" for note in self.notes), ""])


def as_csv(tables: Sequence[PaperTable]) -> str:
    """The rows of all tables with numbers as they are shown, without spreads."""
    columns = dict.fromkeys(c.name for table in tables for c in table.columns)
    text = io.StringIO()
    heads = ["table", "scene", "method", *columns]
    writer = csv.DictWriter(text, heads, lineterminator="\n")
    writer.writeheader()
    for table in tables:
        for row in table.rows:
            names = {"table": table.title, "scene": row.scene, "method": row.label}
            numbers = {
                c.name: cell.value
                for c, cell in zip(table.columns, row.cells, strict=True)
                if not math.isnan(cell.value)
            }
            writer.writerow({name: plain_cell(x) for name, x in names.items()} | numbers)
    return text.getvalue()


def latex_text(text: str) -> str:
    """Text that LaTeX prints as it is, on one line."""
    return " ".join(text.split()).translate(_LATEX)


def paper_tables(
    results: "Sequence[RunResult]",
    *,
    reference: str = "",
    tests: str = "reference",
    views: str = "",
) -> list[PaperTable]:
    """A table of each budget.

    A number of a scene is bold if it is the best and the test over the seeds says that it is better
    than all that it is tested against; a mean, if the test over the scenes says so.

    Args:
        results: All runs.
        reference: Label of the row that all others are tested against; ``named_reference`` if
            empty.
        tests: What is tested: a name in ``TESTS``.
        views: Views that are scored: held_out or mapped; mapped where none is held out if empty.
    """
    has_held_out = any(FIRST_METRIC in result.metrics for result in results)
    views = views or ("held_out" if has_held_out else "mapped")
    reference = reference or named_reference(result.spec for result in results)
    return [
        _table(groups, results, reference, tests, views)
        for groups in by_budget(group_runs(results))
    ]


def _table(
    groups: Sequence[Group],
    results: "Sequence[RunResult]",
    reference: str,
    tests: str,
    views: str,
) -> PaperTable:
    columns = [
        dataclasses.replace(COLUMNS[metric.format(views)], heading=heading)
        for metric, heading in METRICS.items()
    ]
    columns = [c for c in columns if any(g.summary(c.metric).n for g in groups)]
    scenes = list(dict.fromkeys(group.scene for group in groups))
    labels = list(dict.fromkeys(group.label for group in groups))
    own = [run for group in groups for run in group.runs]
    rows = []
    for scene in scenes:
        of_scene = [run for run in own if run.spec.scene == scene]
        best = {c.metric: best_by_test(of_scene, c, reference, tests) for c in columns}
        rows += [
            PaperRow(scene=scene, label=g.label, cells=tuple(_cell(g, c, best) for c in columns))
            for g in groups
            if g.scene == scene
        ]
    if len(scenes) > 1:
        units = scene_units(results)
        best = {c.metric: best_by_test(own, c, reference, tests) for c in columns}
        for label in labels:
            means = (_mean(groups, label, c, units) for c in columns)
            cells = tuple(
                Cell(text=c.text(m), value=c.shown(m), best=best[c.metric] == label)
                for c, m in zip(columns, means, strict=True)
            )
            rows.append(PaperRow(scene=MEAN, label=label, cells=cells))
    against = f" The reference is {reference}." if tests == "reference" else ""
    return PaperTable(
        title=f"Views {views.replace('_', ' ')}, {groups[0].budget}",
        columns=tuple(_for_device(c, own) for c in columns),
        rows=tuple(rows),
        notes=(
            f"Bold: the best, and better by the test. Tests: {TESTS[tests]}.{against}",
            "± is the standard deviation over the seeds.",
        ),
    )


def best_by_test(results: "Sequence[RunResult]", column: Column, reference: str, tests: str) -> str:
    """Label of the row with the best mean, if the test says that it is better than each row that it
    is tested against; else empty.

    Args:
        results: Completed runs of one budget.
        column: What is compared.
        reference: As for ``paper_tables``.
        tests: As for ``paper_tables``.
    """
    groups = group_runs(results)
    units = scene_units(results)
    labels = list(dict.fromkeys(group.label for group in groups))
    means = {label: _mean(groups, label, column, units) for label in labels}
    means = {label: mean for label, mean in means.items() if not math.isnan(mean)}
    if len(means) < 2 or column.better == "neither":
        return ""
    pick = max if column.better == "higher" else min
    best = pick(means, key=lambda label: means[label])
    budget = groups[0].budget
    if tests == "nemenyi":
        better = rank_test(results, budget, column.metric).better
        return best if all((best, other) in better for other in means if other != best) else ""
    comparisons = (
        all_pairs(results, budget, column.metric)
        if tests == "pairs"
        else against_reference(results, budget, reference, column.metric)
    )
    winners = [_winner(c) for c in comparisons if best in (c.a, c.b)]
    return best if winners and set(winners) == {best} else ""


def _winner(comparison: Comparison) -> str:
    return {"a": comparison.a, "b": comparison.b}.get(comparison.verdict, "")


def _cell(group: Group, column: Column, best: Mapping[str, str]) -> Cell:
    summary = group.summary(column.metric)
    spread = "" if math.isnan(summary.sd) else f" ± {column.text(summary.sd)}"
    return Cell(
        text=f"{column.text(summary.mean)}{spread}",
        value=column.shown(summary.mean),
        best=best[column.metric] == group.label,
    )


def _mean(groups: Sequence[Group], label: str, column: Column, units: Mapping[str, str]) -> float:
    """Mean over the scenes of the means over the seeds; scenes of one unit count as one."""
    of_scenes = {g.scene: g.summary(column.metric) for g in groups if g.label == label}
    return summarise(
        over_units({scene: s.mean for scene, s in of_scenes.items() if s.n}, units)
    ).mean


def _for_device(column: Column, runs: "Sequence[RunResult]") -> Column:
    """The column of the memory with its place, where all runs have the same."""
    on_gpu = {run.spec.device.startswith("cuda") for run in runs}
    if column.metric != "peak_memory_mb" or on_gpu != {True}:
        return column
    return dataclasses.replace(column, heading="GPU memory")
