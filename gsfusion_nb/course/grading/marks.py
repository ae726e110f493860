"""Grading a class: points, and the marks of all students as CSV."""

import csv
import io
import os
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from ...files import SequenceError, plain_cell, read_bytes, write_file
from ...work import usable_cores
from ..attempt import Verdict
from ..exercise import DIFFICULTIES, Exercise, exercises
from .sandbox import Limits, verdicts
from .submission import Submission, choose, defines, read_code

COLUMNS = ("student", "exercise", "points", "max", "failed property", "message")
BY_DIFFICULTY = {1: 1.0, 2: 2.0, 3: 3.0, 4: 5.0, 5: 8.0}


class Points:
    """The most points of each exercise.

    Args:
        by_difficulty: Difficulty, 1 to 5, -> points.
        by_name: Name of an exercise -> points, which come before those of its difficulty.
    """

    def __init__(self, by_difficulty: Mapping[int, float] = BY_DIFFICULTY, by_name: Mapping[str, float] | None = None):
        self.by_difficulty, self.by_name = {**BY_DIFFICULTY, **by_difficulty}, dict(by_name or {})

    def of(self, exercise: Exercise) -> float:
        """The most points of ``exercise``."""
        return self.by_name.get(exercise.name, self.by_difficulty[exercise.difficulty])


def read_points(path: Path) -> Points:
    """Points from a TOML file: ``[difficulty]`` with ``1 = 2.0``, ``[exercise]`` with ``psnr = 4``; both are optional.

    Raises:
        ValueError: it is not such a file; the message says which entry.
    """
    try:
        table = tomllib.loads(read_bytes(path, "a table of points").decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, SequenceError) as e:
        raise ValueError(f"{path}: {e}") from None
    known = {"difficulty": {str(d) for d in DIFFICULTIES}, "exercise": set(exercises())}
    for section, entries in table.items():
        for name, value in dict(entries).items():
            if name not in known.get(section, ()) or not isinstance(value, (int, float)) or value < 0:
                raise ValueError(f"{path}: there is no {section} {name!r} with {value!r} points")
    by_difficulty = {int(d): float(v) for d, v in table.get("difficulty", {}).items()}
    return Points(by_difficulty, {name: float(v) for name, v in table.get("exercise", {}).items()})


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


def exercises_of(chapters: Sequence[int], names: Sequence[str], submissions: Sequence[Submission]) -> tuple[str, ...]:
    """The exercises to mark: those named, those of the chapters, or of every chapter that a submission has a part of.

    Raises:
        ValueError: no such exercise or chapter, or nothing in the submissions to recognise a chapter by.
    """
    every = exercises()
    unknown = {*names} - {*every} or {*chapters} - {e.chapter for e in every.values()}
    if unknown:
        raise ValueError(f"no exercise or chapter with exercises {unknown}; there are: {', '.join(every)}")
    wanted = set(chapters)
    if not names and not chapters:
        codes = [read_code(file) for each in submissions for file in each.files]
        wanted = {e.chapter for e in every.values() if any(defines(code, e.name) for code in codes)}
    found = tuple(e.name for e in every.values() if e.name in names or e.chapter in wanted)
    if not found:
        raise ValueError("no submission defines a function of an exercise; name exercises or chapters to mark zeros")
    return found


def grade(
    submissions: Sequence[Submission],
    names: Sequence[str],
    *,
    points: Points,
    limits: Limits,
    jobs: int = 0,
    tell: Callable[[str], None] = lambda line: None,
) -> list[Mark]:
    """The marks of all students, by student and in the order of the course.

    Args:
        submissions: Of each student.
        names: Exercises, in the order of the course.
        points: The most points of each exercise.
        limits: Of each function.
        jobs: Students at the same time; 0: one for each core, at most 8.
        tell: Gets a line for each student.
    """

    def of(submission: Submission) -> list[Mark]:
        marks = _marks(submission, names, points, limits)
        total, most = sum(m.points for m in marks), sum(m.most for m in marks)
        tell(f"{submission.student}: {total:g} of {most:g} points")
        return marks

    with ThreadPoolExecutor(jobs or min(usable_cores(), 8)) as pool:
        return [mark for marks in pool.map(of, submissions) for mark in marks]


def _marks(submission: Submission, names: Sequence[str], points: Points, limits: Limits) -> list[Mark]:
    every = exercises()
    codes = [read_code(file) for file in submission.files]
    chosen = {name: choose(codes, name, every[name].chapter) for name in names}
    found = verdicts({name: code.cells for name, code in chosen.items() if code is not None}, limits)
    problem = next((code.problem for code in codes if code.problem), "")
    marks = []
    for name in names:
        most = points.of(every[name])
        message = problem or f"there is no function {name} in {', '.join(code.file.name for code in codes)}"
        prop, message = why(found[name]) if name in found else ("it is submitted", message)
        right = name in found and bool(found[name])
        marks.append(
            Mark(student=submission.student, exercise=name, points=most * right, most=most, prop=prop, message=message)
        )
    return marks


def why(verdict: Verdict) -> tuple[str, str]:
    """The property that failed, and what was returned and expected; both empty for a right answer."""
    if verdict:
        return "", ""
    if verdict.state == "not written":
        return "it is written", verdict.detail
    return verdict.prop, f"input: {verdict.on}; {verdict.detail}" if verdict.on else verdict.detail


def as_csv(marks: Iterable[Mark]) -> str:
    """The table of marks, one line for each exercise of each student; no cell of it is a formula."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for m in marks:
        student, exercise, prop, message = map(plain_cell, (m.student, m.exercise, m.prop, m.message))
        table.writerow([student, exercise, f"{m.points:g}", f"{m.most:g}", prop, message])
    return text.getvalue()


def write_marks(path: Path, marks: Iterable[Mark]) -> None:
    """Write the table of marks, readable by its owner only."""
    write_file(path, as_csv(marks))
    os.chmod(path, 0o600)
