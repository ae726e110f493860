"""The learner's accepted functions as a backend: ``with use_backend("mine")`` the library runs them.

In a notebook::

    from gsfusion_nb.backends import use_backend
    from gsfusion_nb.course import mine

    check.l1_gradient(l1_gradient)       # accepted: kept for its exercise
    with use_backend("mine"):
        mapper.step(frame)               # the library's mapper, with your gradient of the loss
    mine.board()                         # whose code ran, how often, how long

An exercise says which operation, or which piece of one, its function becomes (``exercise(..., becomes=...)``). For
operations without a kept function the plain reference runs.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Literal

from markupsafe import Markup

from ..backends import CALLS, FUNCTIONS, Calls, replaceable
from ..drawing.page import html_table
from .becomes import KEPT, remember
from .carried import carried
from .exercise import exercises
from .whose import tell, whose_code
from .yours import LearnerError as LearnerError

_GREEN, _GREY, _BLUE = "#1a7f37", "#6e7781", "#0969da"


def keep(exercise: str, function: Callable[..., Any]) -> None:
    """Use ``function`` for its exercise from now on, without a check; ``check.<exercise>(function)`` keeps what passes.

    The newest function counts. One whose exercise becomes no operation is kept, too, and runs nowhere.

    Raises:
        KeyError: there is no such exercise.
    """
    known = exercises()
    if exercise not in known:
        raise KeyError(f"there is no exercise {exercise!r}")
    remember(exercise, known[exercise].becomes, function)


def load(*, missing: Literal["reference", "solution"] = "reference", chapters: Collection[int] | None = None) -> None:
    """Use the functions that were accepted in earlier chapters, too, from the course file.

    They are checked again, because the file can be edited; one that fails is named, and not used.

    Args:
        chapters: Only exercises of these chapters; those of others run as they are kept now. Default: all.
        missing: What runs for an exercise without an accepted function: the reference, or the course's solution, which
            the board shows as such.

    Raises:
        CourseFileError: the file is damaged, or a newer version of the program wrote it.
    """
    known = {name: e for name, e in exercises().items() if chapters is None or e.chapter in chapters}
    for name, function in carried().items():
        if name in known and name not in KEPT:
            verdict = known[name].verdict(function)
            if verdict:
                keep(name, function)
            else:
                tell(whose_code(verdict))
    for name, exercise in known.items():
        if missing == "solution" and name not in KEPT:
            keep(name, exercise._solution)


def forget(*names: str) -> None:
    """Forget the functions of these exercises, or of all; the reference runs again in their place."""
    known = exercises()
    for name in names or tuple(KEPT):
        KEPT.pop(name, None)
        becomes = known[name].becomes if name in known else None
        if becomes is not None:
            FUNCTIONS.pop(becomes.operation, None)


def kept() -> dict[str, Callable[..., Any]]:
    """Exercise -> the learner's function that is kept for it, in the order of the course."""
    return {name: KEPT[name] for name in exercises() if name in KEPT}


def clear_counts() -> None:
    """Set the numbers of calls and the times of the board to zero."""
    CALLS.clear()


@dataclass(frozen=True, kw_only=True)
class BoardRow:
    """One operation, or one piece of an operation, on the board."""

    operation: str
    """Name of the function of the library."""
    exercise: str
    """The exercise whose function replaces it, or "" if there is none."""
    is_yours: bool
    """Whether a function of the learner is kept for it."""
    is_solution: bool
    """Whether the course's solution is kept for it."""
    calls: Calls
    """Calls since the counts were last cleared."""

    @property
    def whose(self) -> str:
        """In words: yours, reference, solution, or both where yours leaves some calls to the reference."""
        if self.is_solution:
            return "solution"
        if self.is_yours and self.calls.reference:
            return f"yours, {self.calls.reference} calls by the reference"
        return "yours" if self.is_yours else "reference"


class Board:
    """Which operations run the learner's code, how often they were called, and for how long. Made by ``board``."""

    def __init__(self, rows: list[BoardRow]):
        self.rows = rows

    @property
    def yours(self) -> list[str]:
        """Operations for which a function of the learner is kept."""
        return [row.operation for row in self.rows if row.is_yours]

    @property
    def line(self) -> str:
        """A summary in one line."""
        exercise_rows = [row for row in self.rows if row.exercise]
        return f"{len(self.yours)} of {len(exercise_rows)} operations that have an exercise run your code"

    def __repr__(self) -> str:
        head = f"{'operation':26} {'whose':10} {'calls':>8} {'ms':>9} {'ms/call':>8}  exercise"
        rows = [
            f"{row.operation:26} {'YOURS' if row.is_yours else row.whose:10} {n:8,} {1e3 * s:9.1f} {each:>8}  "
            f"{row.exercise}"
            for row, n, s, each in self._numbers()
        ]
        return "\n".join([head, *rows, self.line])

    def _repr_html_(self) -> str:
        mark = Markup('<span style="color:{}">●</span> <b>{}</b>')
        rows = [
            (mark.format(_colour(row), row.operation), row.whose, f"{n:,}", f"{1e3 * s:.1f}", each,
             row.exercise)
            for row, n, s, each in self._numbers()
        ]  # fmt: skip
        heads = ("operation", "whose code", "calls", "ms", "ms per call", "exercise")
        style = "font-size:12px"
        return html_table(rows, heads=heads, foot=self.line, style=style, cell_style="text-align:left")

    def _numbers(self) -> list[tuple[BoardRow, int, float, str]]:
        """Each row with its number of calls, its seconds, and the milliseconds of one call."""
        numbers = []
        for row in self.rows:
            n, s = row.calls.own + row.calls.reference, row.calls.seconds
            numbers.append((row, n, s, f"{1e3 * s / n:.3g}" if n else "-"))
        return numbers


def _colour(row: BoardRow) -> str:
    return _BLUE if row.is_solution else _GREEN if row.is_yours else _GREY


def board(chapters: Collection[int] | None = None) -> Board:
    """Every operation that has an exercise or has run: whose code, how often, how long. Yours come first.

    The time of an operation does not contain that of other operations that it calls, so the times add up.

    Args:
        chapters: Of operations that have not run, only those with an exercise in these chapters. Default: all.
    """
    known = exercises()
    by_operation = {e.becomes.operation: e.name for e in known.values() if e.becomes is not None}

    def is_solution(name: str) -> bool:
        exercise = by_operation.get(name, "")
        return exercise in KEPT and KEPT[exercise] is known[exercise]._solution

    shown = {
        name
        for name, exercise in by_operation.items()
        if name in CALLS or chapters is None or known[exercise].chapter in chapters
    }
    names = [*(name for name in by_operation if name in shown), *(name for name in CALLS if name not in by_operation)]
    rows = [
        BoardRow(
            operation=name,
            exercise=by_operation.get(name, ""),
            is_yours=name in FUNCTIONS and not is_solution(name),
            is_solution=is_solution(name),
            calls=CALLS.get(name, Calls()),
        )
        for name in names
    ]
    return Board(sorted(rows, key=lambda row: (not row.is_yours, not row.is_solution)))


def check_becomes() -> None:
    """Raise ``ValueError`` if an exercise becomes an operation that does not exist (tests)."""
    for exercise in exercises().values():
        if exercise.becomes is not None and exercise.becomes.operation not in replaceable():
            raise ValueError(f"{exercise.name} becomes {exercise.becomes.operation}, which is no operation or piece")
