"""The lab's tables: one row per rule, with mean and spread in each cell."""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from .paired_tests import Comparison, against_reference, all_pairs, named_reference, p_text
from .scene_units import scene_units, shared_frames
from .statistics import (
    COLUMNS,
    FIRST_METRIC,
    Column,
    Group,
    Summary,
    by_budget,
    group_runs,
    standings,
)
from .table_notes import (
    OTHERWISE,
    note_on_seeds,
    note_on_tests,
    notes_on_rows,
    notes_on_table,
    trained_otherwise,
)

if TYPE_CHECKING:
    from .run_result import RunResult


RANK = Column(metric="rank", heading="Mean rank", digits=2, better="lower")
_TEST_COLUMNS = (
    Column(metric="difference", heading="Rule minus reference", unit=COLUMNS[FIRST_METRIC].unit),
    Column(metric="p", heading="p", digits=3),
)

SHORT = (FIRST_METRIC, "depth_l1_held_out_m", "n_gaussians", "ms_per_frame")
"""Numbers of the short table."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One cell."""

    text: str
    """In the column's unit and digits: "24.81 ± 0.06"; the standard deviation is that over the
    seeds."""
    value: float = math.nan
    """The mean in the unit of the column, for sorting; NaN if there is none."""
    best: bool = False
    """Whether no rule has a better mean in the digits that are shown."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One rule."""

    label: str
    cells: tuple[Cell, ...]
    mark: str = ""
    """Sign behind the label, which a note explains."""


@dataclass(frozen=True, kw_only=True)
class ResultTable:
    """A table with one row per rule."""

    budget: str
    scene: str
    """Empty: over all scenes."""
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    """Sentences under the table."""

    @property
    def title(self) -> str:
        """Scene and budget."""
        return f"{self.scene or 'All scenes'}, {self.budget}"

    @property
    def short(self) -> "ResultTable":
        """The table with the columns that a reader looks at first, ``SHORT``; all columns if it is
        a table of all scenes."""
        return self._with([not self.scene or c.metric in SHORT for c in self.columns])

    @property
    def rest(self) -> "ResultTable":
        """The table with the columns that ``short`` leaves out."""
        return self._with([bool(self.scene) and c.metric not in SHORT for c in self.columns])

    def _with(self, is_shown: Sequence[bool]) -> "ResultTable":
        """The table with some of its columns."""
        rows = (
            dataclasses.replace(row, cells=tuple(itertools.compress(row.cells, is_shown)))
            for row in self.rows
        )
        columns = tuple(itertools.compress(self.columns, is_shown))
        return dataclasses.replace(self, columns=columns, rows=tuple(rows))


def all_tables(
    results: "Sequence[RunResult]",
    *,
    reference: str = "",
    tests: str = "reference",
    tuned_on: Mapping[str, str] | None = None,
) -> list[ResultTable]:
    """For each budget: the rules with the scenes as columns, if there are several, and a table of
    each scene.

    Args:
        results: All runs.
        reference: Label of the rule that all others are tested against; ``named_reference`` if
            empty.
        tests: What is tested: a name in ``TESTS``.
        tuned_on: Label of a rule -> the scenes that its values were chosen on.
    """
    tables = []
    units = scene_units(results)
    reference = reference or named_reference(result.spec for result in results)
    for of_budget in by_budget(group_runs(results)):
        scenes = list(dict.fromkeys(group.scene for group in of_budget))
        if len(scenes) > 1:
            budget = of_budget[0].budget
            comparisons = (
                against_reference(results, budget, reference) if tests == "reference" else []
            )
            comparisons = all_pairs(results, budget) if tests == "pairs" else comparisons
            table = _scenes_table(
                of_budget,
                reference,
                [c.towards(reference) for c in comparisons],
                tuned_on or {},
                units,
            )
            tables.append(
                dataclasses.replace(
                    table, notes=(*table.notes, note_on_tests(reference, tests, comparisons))
                )
            )
        tables += [scene_table([g for g in of_budget if g.scene == scene]) for scene in scenes]
    return tables


def scene_table(groups: Sequence[Group]) -> ResultTable:
    """The rules on one scene at one budget, best held-out PSNR first, with all of ``COLUMNS`` that
    any run has."""
    order = sorted(groups, key=lambda g: _descending(g.summary(FIRST_METRIC).mean))
    columns = [c for c in COLUMNS.values() if any(g.summary(c.metric).n for g in groups)]
    # nobody is better in it
    fixed_columns = {"n_gaussians"} if any(g.fixes_size for g in groups) else set()
    cells = [
        _cells(
            c,
            [g.summary(c.metric) for g in order],
            marked=c.metric not in fixed_columns,
        )
        for c in columns
    ]
    return ResultTable(
        budget=groups[0].budget,
        scene=groups[0].scene,
        columns=tuple(columns),
        rows=_rows([g.label for g in order], cells, trained_otherwise(groups)),
        notes=tuple(notes_on_table(groups)),
    )


def _scenes_table(
    groups: Sequence[Group],
    reference: str,
    tests: Sequence[Comparison],
    tuned_on: Mapping[str, str],
    units: Mapping[str, str],
) -> ResultTable:
    """The rules of one budget with the scenes as columns, best mean over the scenes first."""
    column = COLUMNS[FIRST_METRIC]
    order = standings(groups, units)
    labels = [s.label for s in order]
    scenes = list(dict.fromkeys(g.scene for g in groups))
    n_units = len({units[scene] for scene in scenes})
    summaries = {(g.label, g.scene): g.summary(FIRST_METRIC) for g in groups}
    nothing = Summary(math.nan, math.nan, 0)
    cells = [
        _cells(column, [summaries.get((label, scene), nothing) for label in labels])
        for scene in scenes
    ]
    cells.append(
        _cells(
            column,
            [dataclasses.replace(s.over_scenes, sd=math.nan) for s in order],
        )
    )
    cells.append([Cell(text=RANK.text(s.rank), value=RANK.shown(s.rank)) for s in order])
    notes = [
        f"{column.name} on each scene, the mean over the scenes, and the mean of the ranks; ties "
        "share a rank"
    ]
    notes += shared_frames({scene: units[scene] for scene in scenes})
    against = {c.a: c for c in tests if c.b == reference}
    if against:
        pairs = [_test_cells(against.get(label)) for label in labels]
        cells += [[difference for difference, _ in pairs], [p for _, p in pairs]]
        notes.append(
            f"last columns: mean difference to {reference} with its 95 % interval, and p of the "
            "paired t test over "
            f"the {n_units} scenes, corrected by Holm's method for {tests[0].n_tests} comparisons"
        )
    notes += notes_on_rows(groups)
    notes += [
        f"{label} was tuned on: {where}" for label, where in tuned_on.items() if label in labels
    ]
    return ResultTable(
        budget=groups[0].budget,
        scene="",
        columns=(
            *(dataclasses.replace(column, heading=scene) for scene in (*scenes, "Mean")),
            RANK,
            *(_TEST_COLUMNS if against else ()),
        ),
        rows=_rows(labels, cells, trained_otherwise(groups)),
        notes=(*notes, note_on_seeds(groups)),
    )


def _rows(
    labels: Sequence[str],
    cells: Sequence[Sequence[Cell]],
    marks: Mapping[str, str],
) -> tuple[Row, ...]:
    """A row of each rule; ``cells`` are the columns."""
    return tuple(
        Row(
            label=label,
            cells=tuple(of[i] for of in cells),
            mark=OTHERWISE if label in marks else "",
        )
        for i, label in enumerate(labels)
    )


def _cells(
    column: Column,
    summaries: Sequence[Summary],
    *,
    marked: bool = True,
) -> list[Cell]:
    """A column over the rules; the best are marked unless neither direction is better, or all are
    the same."""
    values = [column.shown(s.mean) for s in summaries]
    numbers = {v for v in values if not math.isnan(v)}
    best = None
    if len(numbers) > 1 and column.better != "neither" and marked:
        best = max(numbers) if column.better == "higher" else min(numbers)
    return [
        Cell(
            text=column.text(s.mean) + ("" if math.isnan(s.sd) else f" ± {column.text(s.sd)}"),
            value=value,
            best=value == best,
        )
        for s, value in zip(summaries, values, strict=True)
    ]


def _test_cells(test: Comparison | None) -> tuple[Cell, Cell]:
    """Difference with its interval, and corrected p; dashes for the reference itself."""
    if test is None or math.isnan(test.mean):
        return Cell(text="–"), Cell(text="–")
    column = COLUMNS[test.metric]
    p = test.p if math.isnan(test.corrected) else test.corrected
    low, high = (column.text(v) for v in test.interval)
    words = f"{column.text(test.mean)} ({low} to {high})"
    p_words = p_text(p).removeprefix("p ").removeprefix("= ")
    return Cell(text=words, value=column.shown(test.mean)), Cell(text=p_words, value=p)


def _descending(value: float) -> float:
    return math.inf if math.isnan(value) else -value


def failures(results: "Iterable[RunResult]") -> list[tuple[str, str, str, int, str]]:
    """Label, scene, budget, seed and reason of each run that failed."""
    return [
        (r.spec.label, r.spec.scene, str(r.spec.budget), r.spec.seed, r.reason)
        for r in results
        if r.status == "failed"
    ]
