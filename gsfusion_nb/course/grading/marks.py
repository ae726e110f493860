"""Marks: points, and the table of all students as CSV."""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ...errors import ArgumentError
from ...files import plain_cell, write_file
from ..exercise import exercises
from ..verdict import Verdict
from .submission import Submission, defines, read_code

COLUMNS = ("student", "exercise", "points", "max", "failed property", "message", "seconds")
BY_DIFFICULTY = {1: 1.0, 2: 2.0, 3: 3.0, 4: 5.0, 5: 8.0}
"""The most points of an exercise."""


@dataclass(frozen=True, kw_only=True)
class Mark:
    """One line of the table of marks."""

    student: str
    exercise: str
    points: float
    most: float
    prop: str = ""
    """The property that failed; empty for a right answer."""
    message: str = ""
    """What was returned and what was expected, or why nothing could be judged."""
    seconds: float = 0.0
    """That the judge took, with the start of the process."""


def exercises_of(
    chapters: Sequence[int], names: Sequence[str], submissions: Sequence[Submission]
) -> tuple[str, ...]:
    """The exercises to mark: those named, those of the chapters, or of every chapter that a
    submission has a part of.

    Raises:
        ValueError: no such exercise or chapter, or nothing in the submissions to recognise a
            chapter by.
    """
    every = exercises()
    unknown = {*names} - {*every} or {*chapters} - {e.chapter for e in every.values()}
    if unknown:
        raise ArgumentError(
            f"no exercise or chapter with exercises {unknown}; there are: {', '.join(every)}"
        )
    numbers = set(chapters)
    if not names and not chapters:
        codes = [read_code(file) for each in submissions for file in each.files]
        numbers = {
            e.chapter for e in every.values() if any(defines(code, e.name) for code in codes)
        }
    selection = tuple(e.name for e in every.values() if e.name in names or e.chapter in numbers)
    if not selection:
        raise ArgumentError(
            "no submission defines a function of an exercise; name exercises or chapters to mark "
            "zeros"
        )
    return selection


def mark_of(student: str, exercise: str, verdict: Verdict, seconds: float = 0.0) -> Mark:
    """All points for a right answer, and none for another one."""
    most = most_points(exercise)
    prop, message = why(verdict)
    return Mark(
        student=student,
        exercise=exercise,
        points=most if verdict else 0.0,
        most=most,
        prop=prop,
        message=message,
        seconds=seconds,
    )


def most_points(exercise: str) -> float:
    """The points of a right answer."""
    return BY_DIFFICULTY[exercises()[exercise].difficulty]


def why(verdict: Verdict) -> tuple[str, str]:
    """The property that failed, and what was returned and expected; both empty for a right
    answer."""
    if verdict:
        return "", ""
    if verdict.state == "not written":
        return "it is written", verdict.detail
    return verdict.prop, f"input: {verdict.on}; {verdict.detail}" if verdict.on else verdict.detail


def as_csv(marks: Iterable[Mark]) -> str:
    """The table of marks, one line for each exercise of each student; no cell of it is a
    formula."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for m in marks:
        student, exercise, prop, message = map(
            plain_cell, (m.student, m.exercise, m.prop, m.message)
        )
        table.writerow(
            [student, exercise, f"{m.points:g}", f"{m.most:g}", prop, message, f"{m.seconds:.1f}"]
        )
    return text.getvalue()


def write_marks(path: Path, marks: Iterable[Mark]) -> None:
    """Write the table of marks, readable by its owner only."""
    write_file(path, as_csv(marks))
    path.chmod(0o600)
