"""The lab's tables: one row per rule, with mean, spread and place in each cell; as Markdown and as LaTeX."""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from .statistics import (
    COLUMNS,
    FIRST_METRIC,
    Column,
    Comparison,
    Group,
    against_reference,
    draws_differ,
    group_runs,
    p_text,
    standings,
)

if TYPE_CHECKING:
    from .spec import Budget, RunResult

Place = Literal[0, 1, 2]
"""1: among the best of the column, within noise of each other; 2: among the next; 0: neither."""

RANK = Column(metric="rank", heading="Mean rank", digits=2, better="lower")
_TESTS = (
    Column(metric="difference", heading="Reference minus rule", unit=COLUMNS[FIRST_METRIC].unit),
    Column(metric="p", heading="p", digits=3),
)


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One cell; the texts have the column's unit and digits."""

    mean: str
    sd: str = ""
    """Standard deviation over the seeds; empty with one seed."""
    place: Place = 0
    value: float = math.nan
    """The mean in the unit of the column, for sorting; NaN if there is none."""

    @property
    def text(self) -> str:
        """ "24.81 ± 0.06"."""
        return f"{self.mean} ± {self.sd}" if self.sd else self.mean


@dataclass(frozen=True, kw_only=True)
class Row:
    """One rule."""

    label: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True, kw_only=True)
class ResultTable:
    """A table with one row per rule."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    """Sentences under the table."""


def scene_table(groups: Sequence[Group], *, title: str = "", columns: Iterable[Column] | None = None) -> ResultTable:
    """The rules on one scene at one budget, best held-out PSNR first.

    Args:
        groups: One per rule.
        title: Heading of the table; "SCENE, BUDGET" if empty.
        columns: The columns; by default all of ``COLUMNS`` that any run has a number for.
    """
    chosen = [c for c in (columns or COLUMNS.values()) if any(g.summary(c.metric).n for g in groups)]
    fixed = _fixed_by_budget(groups)
    cells = [_cells_of_scene(c, groups, marked=c.metric not in fixed) for c in chosen]
    rows = [Row(label=g.label, cells=tuple(column[i] for column in cells)) for i, g in enumerate(groups)]
    order = sorted(range(len(groups)), key=lambda i: _descending(groups[i].summary(FIRST_METRIC).mean))
    return ResultTable(
        title=title or (f"{groups[0].scene}, {groups[0].budget}" if groups else "no runs"),
        columns=tuple(chosen),
        rows=tuple(rows[i] for i in order),
        notes=tuple(notes_of(groups)),
    )


def scenes_table(
    results: "Sequence[RunResult]", budget: str, *, reference: str = "", tuned_on: Mapping[str, str] | None = None
) -> ResultTable:
    """The rules of one budget with the scenes as columns, best mean over the scenes first.

    Args:
        results: All runs.
        budget: Text of the budget.
        reference: Label of the rule that all others are tested against; the first row if empty.
        tuned_on: Label of a rule -> the scenes that its values were chosen on.
    """
    column, groups = COLUMNS[FIRST_METRIC], [g for g in group_runs(results) if g.budget == budget]
    order, tests = standings(groups), against_reference(results, budget, reference)
    labels, scenes = [s.label for s in order], list(dict.fromkeys(g.scene for g in groups))
    found = {(g.label, g.scene): g for g in groups}
    by_scene = [
        _cells_of_scene(
            column,
            [found.get((x, scene), Group(label=x, scene=scene, budget=budget, runs=())) for x in labels],
        )
        for scene in scenes
    ]
    best = tests if tests and tests[0].a == labels[0] else against_reference(results, budget)
    worse = {c.b for c in best if c.verdict == "a"}
    means = [s.over_scenes.mean for s in order]
    mean_cells = [
        Cell(mean=column.text(m), value=column.shown(m), place=1 if worse and m == m and label not in worse else 0)
        for label, m in zip(labels, means, strict=True)
    ]
    rank_cells = [Cell(mean=RANK.text(s.rank), value=RANK.shown(s.rank)) for s in order]
    against = {c.b: c for c in tests}
    rows = [
        Row(
            label=label,
            cells=(
                *(cells[i] for cells in by_scene),
                mean_cells[i],
                rank_cells[i],
                *(_test_cells(against.get(label)) if tests else ()),
            ),
        )
        for i, label in enumerate(labels)
    ]
    name = tests[0].a if tests else ""
    notes = [f"{column.name} on each scene, the mean over the scenes, and the mean of the ranks; ties share a rank"]
    if name:
        notes.append(
            f"last columns: mean difference from {name} with its 95 % interval, and p of the paired t test over the "
            f"{len(scenes)} scenes, corrected by Holm's method for {tests[0].n_tests} comparisons"
        )
    notes += [f"{label} was tuned on: {where}" for label, where in (tuned_on or {}).items() if label in labels]
    left_out = [s.label for s in order if math.isnan(s.over_scenes.mean)]
    notes += [f"no mean for {', '.join(left_out)}: no result on some scenes"] if left_out else []
    return ResultTable(
        title=f"All scenes, {budget}",
        columns=(
            *(dataclasses.replace(column, heading=scene, views="") for scene in scenes),
            dataclasses.replace(column, heading="Mean", views=""), RANK, *(_TESTS if tests else ()),
        ),
        rows=tuple(rows),
        notes=(*notes, *_seeds_note(groups)),
    )  # fmt: skip


def notes_of(groups: Sequence[Group]) -> list[str]:
    """What a reader must know about the runs of one table: seeds, failures, and what was not equal."""
    runs = [run for group in groups for run in group.runs]
    if not runs:
        return ["no run was completed"]
    most = max(len(g.runs) + len(g.failed) for g in groups)
    notes = [*_seeds_note(groups), *(f"{g.label}: {len(g.runs)} of {most} runs" for g in groups if len(g.runs) < most)]
    notes += _what_differs(groups, runs[0].spec.budget)
    return list(dict.fromkeys([*notes, *(f"{run.spec.label}: {note}" for run in runs for note in run.notes)]))


def places(values: Sequence[Sequence[float]], column: Column) -> list[Place]:
    """Which rules are the best and the second of a column, on one scene.

    The best one and those after it, up to the first that differs from it by more than random draws (``draws_differ``),
    share the first place, and likewise the second. Nothing is marked with one seed, if neither direction is better, or
    if no two differ.

    Args:
        values: The number in each run of each rule.
        column: The column.
    """
    sign = 1.0 if column.better == "lower" else -1.0
    left = sorted((i for i, v in enumerate(values) if v), key=lambda i: sign * float(np.mean(values[i])))
    found: list[Place] = [0] * len(values)
    marks: tuple[Place, ...] = () if column.better == "neither" else (1, 2)
    for place in marks:
        best = left[0] if left else 0
        equal = list(itertools.takewhile(lambda i, best=best: not draws_differ(values[best], values[i], column), left))
        left = left[len(equal) :]
        if place == 1 and not left:
            break
        for i in equal:
            found[i] = place
    return found


def failures(results: "Iterable[RunResult]") -> list[tuple[str, str, str, int, str]]:
    """Label, scene, budget, seed and reason of each run that failed."""
    return [
        (r.spec.label, r.spec.scene, str(r.spec.budget), r.spec.seed, r.reason) for r in results if r.status == "failed"
    ]


def _seeds_note(groups: Sequence[Group]) -> list[str]:
    seeds = len({run.spec.seed for group in groups for run in group.runs})
    if seeds < 2:
        return ["one seed: no standard deviation within a scene, and nothing is marked there"]
    return [f"± within a scene: standard deviation over {seeds} seeds, which change only random draws"]


def _test_cells(test: Comparison | None) -> tuple[Cell, Cell]:
    """Difference with its interval, and corrected p; dashes for the reference itself."""
    if test is None or math.isnan(test.mean):
        return Cell(mean="–"), Cell(mean="–")
    column, p = COLUMNS[test.metric], test.p_t if math.isnan(test.corrected) else test.corrected
    low, high = (column.text(v) for v in test.interval)
    words = f"{column.text(test.mean)} ({low} to {high})"
    return Cell(mean=words, value=column.shown(test.mean)), Cell(
        mean=p_text(p).removeprefix("p ").removeprefix("= "), value=p
    )


def _cells_of_scene(column: Column, groups: Sequence[Group], *, marked: bool = True) -> list[Cell]:
    """A column over the rules on one scene."""
    values, summaries = [g.values(column.metric) for g in groups], [g.summary(column.metric) for g in groups]
    marks: list[Place] = places(values, column) if marked else [0] * len(groups)
    return [
        Cell(
            mean=column.text(s.mean), sd="" if math.isnan(s.sd) else column.text(s.sd), place=place,
            value=column.shown(s.mean),
        )
        for s, place in zip(summaries, marks, strict=True)
    ]  # fmt: skip


def _descending(value: float) -> float:
    return math.inf if math.isnan(value) else -value


def _fixed_by_budget(groups: Sequence[Group]) -> set[str]:
    """Numbers that the budget gave to all rules: nobody is better in them."""
    budgets = [run.spec.budget for group in groups for run in group.runs]
    fixed = {"n_gaussians"} if any(b.gaussians is not None for b in budgets) else set()
    return fixed | ({"seconds_total"} if any(b.seconds is not None for b in budgets) else set())


def _what_differs(groups: Sequence[Group], budget: "Budget") -> list[str]:
    """Sentences about Gaussians, steps and time that the rules did not have in common."""
    parts = []
    for metric, noun, own in (
        ("n_gaussians", "Gaussians", budget.gaussians is None and budget.seconds is None),
        ("n_steps", "gradient steps", budget.steps == "own"),
    ):
        means = [s.mean for s in (g.summary(metric) for g in groups) if s.n]
        low, high = min(means, default=0.0), max(means, default=0.0)
        if own and high > low:
            factor = f" (a factor of {high / low:.1f})" if low > 0 else ""
            parts.append(f"{low:,.0f} to {high:,.0f} {noun}{factor}")
    if not parts:
        return []
    return [f"not equal between the rules: {' and '.join(parts)}; quality also depends on these"]


_TEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "±": r"$\pm$", "–": "--", "∞": r"$\infty$", "°": r"$^\circ$", "\u00a0": "~",
}  # fmt: skip
_PREAMBLE = r"""% Written by gsfusion-nb lab. In the document: \usepackage{booktabs,graphicx}, then \input{table}
% Best of a column: bold; second: underlined.
"""


def as_markdown(table: ResultTable) -> str:
    """A heading, the table and its notes; the best of a column bold, the second underlined."""
    heads = ["rule", *(column.name for column in table.columns)]
    lines = [
        f"### {table.title}",
        "",
        f"| {' | '.join(map(_markdown, heads))} |",
        "|---|" + "---:|" * len(table.columns),
    ]
    for row in table.rows:
        lines.append(f"| {' | '.join([_markdown(row.label), *map(_markdown_cell, row.cells)])} |")
    return "\n".join([*lines, "", *(f"- {_markdown(note)}" for note in table.notes)])


def as_latex(table: ResultTable, *, label: str = "") -> str:
    """A ``table`` environment with booktabs, made smaller if it is wider than the line; ± in small print.

    Args:
        table: The table.
        label: For ``\\ref``; none if empty.
    """
    lines = [r"\begin{table}[htbp]", r"\centering\small\setlength{\tabcolsep}{4pt}"]
    lines += [rf"\caption{{{_tex(table.title)}. {_tex(_sentences(table.notes))}}}"]
    lines += [rf"\label{{{label}}}"] if label else []
    lines += [
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        rf"\begin{{tabular}}{{l{'r' * len(table.columns)}}}",
        r"\toprule",
    ]
    lines += _tex_heads(table.columns)
    for row in table.rows:
        lines.append(" & ".join([_tex(row.label), *map(_tex_cell, row.cells)]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}}", r"\end{table}"])


def latex_file(tables: Iterable[ResultTable]) -> str:
    """Several tables as one file for ``\\input``, each split into quality and cost if it is wide."""
    parts = [part for table in tables for part in _parts(table)]
    return _PREAMBLE + "\n\n".join(as_latex(part, label=f"tab:lab-{i}") for i, part in enumerate(parts, 1)) + "\n"


def _parts(table: ResultTable) -> list[ResultTable]:
    """Quality and cost as separate tables: a page of LaTeX has no room for both."""
    groups = {c.group: [i for i, d in enumerate(table.columns) if d.group == c.group] for c in table.columns}
    if len(groups) == 1:
        return [table]
    return [
        dataclasses.replace(
            table,
            title=f"{table.title}: {group}",
            columns=tuple(table.columns[i] for i in chosen),
            rows=tuple(dataclasses.replace(row, cells=tuple(row.cells[i] for i in chosen)) for row in table.rows),
        )
        for group, chosen in groups.items()
    ]


def _markdown(text: str) -> str:
    return "".join(f"\\{c}" if c in "\\|*_`<>[]#" else " " if c in "\r\n" else c for c in text)


def _markdown_cell(cell: Cell) -> str:
    return {0: "{}", 1: "**{}**", 2: "<u>{}</u>"}[cell.place].format(cell.text)


def _tex_heads(columns: Sequence[Column]) -> list[str]:
    """A row of headings; neighbours that differ only in the views share a heading in a row above."""
    above, rules, below = [""], [], ["rule"]
    for heading, found in itertools.groupby(columns, key=lambda c: (c.heading, c.unit)):
        run = list(found)
        words = _tex(heading[0]) + (f" [{_tex(heading[1])}]" if heading[1] else "")
        first = len(below) + 1
        if len(run) > 1:
            above.append(rf"\multicolumn{{{len(run)}}}{{c}}{{{words}}}")
            rules.append(rf"\cmidrule(lr){{{first}-{first + len(run) - 1}}}")
            below += [_tex(c.views) for c in run]
        else:
            above.append("")
            below.append(f"{words} {run[0].views}".strip())
    top = [" & ".join(above) + r" \\", " ".join(rules)] if rules else []
    return [*top, " & ".join(below) + r" \\", r"\midrule"]


def _tex_cell(cell: Cell) -> str:
    spread = rf" {{\scriptsize$\pm$ {_tex(cell.sd)}}}" if cell.sd else ""
    return {0: "{}", 1: r"\textbf{{{}}}", 2: r"\underline{{{}}}"}[cell.place].format(_tex(cell.mean)) + spread


def _sentences(notes: Sequence[str]) -> str:
    return " ".join(f"{note[:1].upper()}{note[1:]}." for note in notes)


def _tex(text: str) -> str:
    return "".join(_TEX.get(c, c) for c in text)
