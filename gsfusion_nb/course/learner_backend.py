"""The learner's accepted functions as a backend: ``with use_backend("mine")`` the library runs
them.

In a notebook::

    from gsfusion_nb.backends import use_backend
    from gsfusion_nb.course import mine

    check.l1_gradient(l1_gradient)       # accepted: kept for its exercise
    with use_backend("mine"):
        mapper.step(frame)               # the library's mapper, with your gradient of the loss
    mine.board()                         # whose code ran, how often, how long

An exercise says which operation, or which piece of one, its function becomes
(``exercise(..., becomes=...)``). For operations without a kept function the plain reference runs.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Literal

from ..backends import CALLS, FUNCTIONS, Calls
from ..errors import UnknownNameError
from .exercise import exercises
from .kept_functions import functions_of_earlier_chapters
from .learner_operation import KEPT as KEPT
from .learner_operation import LearnerError as LearnerError
from .learner_operation import remember


def keep(exercise: str, function: Callable[..., Any]) -> None:
    """Use ``function`` for its exercise from now on, without a check;
    ``check.<exercise>(function)`` keeps what passes.

    The newest function counts. One whose exercise becomes no operation is kept, too, and runs
    nowhere.

    Raises:
        KeyError: there is no such exercise.
    """
    all_exercises = exercises()
    if exercise not in all_exercises:
        raise UnknownNameError(f"there is no exercise {exercise!r}")
    remember(exercise, all_exercises[exercise].becomes, function)


def load(
    *,
    missing: Literal["reference", "solution"] = "reference",
    chapters: Collection[int] | None = None,
) -> None:
    """Use the functions that were accepted in earlier chapters, too, from the course file.

    They are checked again, because the file can be edited; one that fails is named, and not used.

    Args:
        chapters: Only exercises of these chapters; those of others run as they are kept now.
            Default: all.
        missing: What runs for an exercise without an accepted function: the reference, or the
            course's solution, which the board shows as such.

    Raises:
        CourseFileError: the file is damaged, or a newer version of the program wrote it.
    """
    all_exercises = {
        name: e for name, e in exercises().items() if chapters is None or e.chapter in chapters
    }
    for name, function in functions_of_earlier_chapters().items():
        if name in all_exercises and name not in KEPT:
            verdict = all_exercises[name].verdict(function)
            if verdict:
                keep(name, function)
            else:
                verdict.code_in_use.tell()
    for name, exercise in all_exercises.items():
        if missing == "solution" and name not in KEPT:
            keep(name, exercise._solution)


def forget(*names: str) -> None:
    """Forget the functions of these exercises, or of all; the reference runs again in their
    place."""
    all_exercises = exercises()
    for name in names or tuple(KEPT):
        KEPT.pop(name, None)
        becomes = all_exercises[name].becomes if name in all_exercises else None
        if becomes is not None:
            FUNCTIONS.pop(becomes.operation, None)


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
    code: Literal["yours", "solution", "reference"]
    """What is kept for it."""
    calls: Calls
    """Calls since the counts were last cleared."""

    @property
    def whose(self) -> str:
        """In words: yours, reference, solution, or both where yours leaves some calls to the
        reference."""
        if self.code == "yours" and self.calls.reference:
            return f"yours, {self.calls.reference} calls by the reference"
        return self.code


class Board:
    """Which operations run the learner's code, how often they were called, and for how long. Made
    by ``board``."""

    def __init__(self, rows: list[BoardRow]):
        self.rows = rows

    @property
    def yours(self) -> list[str]:
        """Operations for which a function of the learner is kept."""
        return [row.operation for row in self.rows if row.code == "yours"]

    @property
    def line(self) -> str:
        """A summary in one line."""
        exercise_rows = [row for row in self.rows if row.exercise]
        return (
            f"{len(self.yours)} of {len(exercise_rows)} operations that have an exercise run "
            "your code"
        )

    def __repr__(self) -> str:
        head = f"{'operation':26} {'whose':10} {'calls':>8} {'ms':>9} {'ms/call':>8}  exercise"
        rows = []
        for row in self.rows:
            n = row.calls.own + row.calls.reference
            s = row.calls.seconds
            whose = "YOURS" if row.code == "yours" else row.whose
            each = f"{1e3 * s / n:.3g}" if n else "-"
            rows.append(
                f"{row.operation:26} {whose:10} {n:8,} {1e3 * s:9.1f} {each:>8}  {row.exercise}"
            )
        return "\n".join([head, *rows, self.line])


def board(chapters: Collection[int] | None = None) -> Board:
    """Every operation that has an exercise or has run: whose code, how often, how long. Yours come
    first.

    The time of an operation does not contain that of other operations that it calls, so the times
    add up.

    Args:
        chapters: Of operations that have not run, only those with an exercise in these chapters.
            Default: all.
    """
    all_exercises = exercises()
    of_operation = {e.becomes.operation: e for e in all_exercises.values() if e.becomes is not None}
    lines = [
        name
        for name, e in of_operation.items()
        if name in CALLS or chapters is None or e.chapter in chapters
    ]

    def row(name: str) -> BoardRow:
        exercise = of_operation[name].name if name in of_operation else ""
        is_solution = exercise in KEPT and KEPT[exercise] is all_exercises[exercise]._solution
        code = "solution" if is_solution else "yours" if name in FUNCTIONS else "reference"
        return BoardRow(
            operation=name, exercise=exercise, code=code, calls=CALLS.get(name, Calls())
        )

    rows = [row(name) for name in [*lines, *(name for name in CALLS if name not in of_operation)]]
    return Board(sorted(rows, key=lambda row: ("yours", "solution", "reference").index(row.code)))
