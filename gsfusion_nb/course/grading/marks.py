"""Grading a class: points, and the marks of all students as CSV."""

import csv
import io
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from ...errors import ArgumentError
from ...files import plain_cell, write_file
from ...resources import usable_cores
from ..attempt import Verdict
from ..exercise import exercises
from .sandbox import Limits, verdicts
from .submission import Submission, choose, defines, read_code

COLUMNS = ("student", "exercise", "points", "max", "failed property", "message")
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


def grade(
    submissions: Sequence[Submission],
    names: Sequence[str],
    *,
    limits: Limits,
    jobs: int = 0,
    tell: Callable[[str], None] = lambda line: None,
) -> list[Mark]:
    """The marks of all students, by student and in the order of the course.

    Args:
        submissions: Of each student.
        names: Exercises, in the order of the course.
        limits: Of each function.
        jobs: Students at the same time; 0: one for each core, at most 8.
        tell: Gets a line for each student.
    """

    def of(submission: Submission) -> list[Mark]:
        marks = _marks(submission, names, limits)
        total = sum(m.points for m in marks)
        most = sum(m.most for m in marks)
        tell(f"{submission.student}: {total:g} of {most:g} points")
        return marks

    with ThreadPoolExecutor(jobs or min(usable_cores(), 8)) as pool:
        return [mark for marks in pool.map(of, submissions) for mark in marks]


def _marks(submission: Submission, names: Sequence[str], limits: Limits) -> list[Mark]:
    every = exercises()
    codes = [read_code(file) for file in submission.files]
    answers = {name: choose(codes, name, every[name].chapter) for name in names}
    verdict_of = verdicts(
        {name: code.cells for name, code in answers.items() if code is not None}, limits
    )
    problem = next((code.problem for code in codes if code.problem), "")
    marks = []
    for name in names:
        most = BY_DIFFICULTY[every[name].difficulty]
        message = (
            problem
            or f"there is no function {name} in {', '.join(code.file.name for code in codes)}"
        )
        prop, message = (
            why(verdict_of[name]) if name in verdict_of else ("it is submitted", message)
        )
        right = name in verdict_of and bool(verdict_of[name])
        marks.append(
            Mark(
                student=submission.student,
                exercise=name,
                points=most * right,
                most=most,
                prop=prop,
                message=message,
            )
        )
    return marks


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
        table.writerow([student, exercise, f"{m.points:g}", f"{m.most:g}", prop, message])
    return text.getvalue()


def write_marks(path: Path, marks: Iterable[Mark]) -> None:
    """Write the table of marks, readable by its owner only."""
    write_file(path, as_csv(marks))
    os.chmod(path, 0o600)
