"""The lab's tables before they become Markdown, LaTeX or HTML: one row per rule; mean, spread and place in each
cell."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from .columns import COLUMNS, FIRST_METRIC, Column
from .statistics import Group, Summary, rank_rules

if TYPE_CHECKING:
    from .result import RunResult
    from .spec import Budget

Place = Literal[0, 1, 2]
"""1: the best of the column; 2: the second; 0: neither."""

RANK = Column(metric="rank", heading="Mean rank", digits=2, better="lower")


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
    summaries = [[group.summary(c.metric) for group in groups] for c in chosen]
    cells = [_column_cells(c, s, marked=c.metric not in fixed) for c, s in zip(chosen, summaries, strict=True)]
    rows = [Row(label=g.label, cells=tuple(column[i] for column in cells)) for i, g in enumerate(groups)]
    order = sorted(range(len(groups)), key=lambda i: _descending(groups[i].summary(FIRST_METRIC).mean))
    return ResultTable(
        title=title or (f"{groups[0].scene}, {groups[0].budget}" if groups else "no runs"),
        columns=tuple(chosen),
        rows=tuple(rows[i] for i in order),
        notes=tuple(notes_of(groups)),
    )


def rank_table(groups: Sequence[Group], *, metric: str = FIRST_METRIC) -> ResultTable:
    """The rules of one budget over the scenes: one number per scene, and the mean rank; best mean rank first."""
    column = COLUMNS[metric]
    ranks, scenes = rank_rules(groups, metric=metric), list(dict.fromkeys(g.scene for g in groups))
    found = {(g.label, g.scene): g.summary(metric) for g in groups}
    missing = Summary(math.nan, math.nan, 0)
    by_scene = [_column_cells(column, [found.get((label, scene), missing) for label in ranks]) for scene in scenes]
    means = _column_cells(RANK, [Summary(rank.mean, math.nan, 1) for rank in ranks.values()])
    rows = [
        Row(label=label, cells=(*(cells[i] for cells in by_scene), means[i])) for i, label in enumerate(ranks)
    ]  # fmt: skip
    notes = [f"{column.name} on each scene, and the mean of the ranks on all scenes; ties share a rank"]
    left_out = [label for label, rank in ranks.items() if math.isnan(rank.mean)]
    notes += [f"no mean rank for {', '.join(left_out)}: no result on some scenes"] if left_out else []
    return ResultTable(
        title=f"Ranks over scenes, {groups[0].budget}" if groups else "no runs",
        columns=(*(dataclasses.replace(column, heading=scene, views="") for scene in scenes), RANK),
        rows=tuple(rows),
        notes=tuple(notes),
    )


def places(values: Sequence[float], column: Column) -> list[Place]:
    """Which values are the best and the second of a column.

    Values that are equal in the digits shown have the same place. After two best there is no second. Nothing is marked
    if neither direction is better, or if no two values differ.
    """
    shown = [column.shown(v) for v in values]
    sign = 1.0 if column.better == "lower" else -1.0
    order = sorted(sign * v for v in shown if not math.isnan(v))
    if column.better == "neither" or len(set(order)) < 2:
        return [0] * len(values)
    best, second = order[0], order[1]
    return [1 if sign * v == best else 2 if sign * v == second else 0 for v in shown]


def notes_of(groups: Sequence[Group]) -> list[str]:
    """What a reader must know about the runs of one table: seeds, failures, and what was not equal."""
    runs = [run for group in groups for run in group.runs]
    if not runs:
        return ["no run was completed"]
    seeds = len({run.spec.seed for run in runs})
    notes = [f"mean ± standard deviation over {seeds} seeds" if seeds > 1 else "one seed: no standard deviation"]
    most = max(len(g.runs) + len(g.failed) for g in groups)
    notes += [f"{g.label}: {len(g.runs)} of {most} runs" for g in groups if len(g.runs) < most]
    notes += _what_differs(groups, runs[0].spec.budget)
    return list(dict.fromkeys([*notes, *(f"{run.spec.label}: {note}" for run in runs for note in run.notes)]))


def failures(results: "Iterable[RunResult]") -> list[tuple[str, str, str, int, str]]:
    """Label, scene, budget, seed and reason of each run that failed."""
    return [
        (r.spec.label, r.spec.scene, str(r.spec.budget), r.spec.seed, r.reason) for r in results if r.status == "failed"
    ]


def _column_cells(column: Column, summaries: Sequence[Summary], *, marked: bool = True) -> list[Cell]:
    marks: list[Place] = [0] * len(summaries)
    if marked:
        marks = places([s.mean for s in summaries], column)
    return [
        Cell(
            mean=column.text(s.mean),
            sd="" if math.isnan(s.sd) else column.text(s.sd),
            place=place,
            value=column.shown(s.mean),
        )
        for s, place in zip(summaries, marks, strict=True)
    ]


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
