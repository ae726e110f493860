"""Grading a class: points, marks of all students as CSV, and the page that says what the points are for."""

import csv
import io
import os
import secrets
import tempfile
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...drawing.page import fill
from ...files import SequenceError, plain_cell, read_bytes, write_file
from ...work import Died, WorkerPool, usable_cores
from ..course import TITLES
from ..exercise import DIFFICULTIES, Exercise, exercises
from .marking import properties, verdicts, why
from .sandbox import Limits, check_possible
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
    unknown = set(table) - {"difficulty", "exercise"}
    if unknown:
        raise ValueError(f"{path}: unknown section {sorted(unknown)[0]!r}; there are difficulty and exercise")
    known = {"difficulty": {str(d) for d in DIFFICULTIES}, "exercise": set(exercises())}
    for section, names in known.items():
        for name, value in table.get(section, {}).items():
            if name not in names:
                raise ValueError(f"{path}: there is no {section} {name!r}")
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < 1e6:
                raise ValueError(f"{path}: the points of {section} {name} must be a number from 0 on, got {value!r}")
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


@dataclass(frozen=True, kw_only=True)
class Grading:
    """How a class is graded."""

    names: tuple[str, ...]
    """Exercises, in the order of the course."""
    points: Points
    limits: Limits
    seed: int


def new_seed() -> int:
    """A seed that nobody has seen."""
    return secrets.randbelow(10**9)


def exercises_of(chapters: Sequence[int], names: Sequence[str], submissions: Sequence[Submission]) -> tuple[str, ...]:
    """The exercises to mark: those named, those of the chapters, or of every chapter that a submission has a part of.

    Raises:
        ValueError: no such exercise or chapter, or nothing in the submissions to recognise a chapter by.
    """
    every = exercises()
    for name in names:
        if name not in every:
            raise ValueError(f"no exercise {name!r}; there are: {', '.join(every)}")
    known = {e.chapter for e in every.values()}
    for chapter in chapters:
        if chapter not in known:
            raise ValueError(f"no chapter {chapter} with exercises; there are {', '.join(map(str, sorted(known)))}")
    wanted = set(chapters)
    if not names and not chapters:
        codes = [read_code(file) for each in submissions for file in each.files]
        wanted = {e.chapter for e in every.values() if any(defines(code, e.name) for code in codes)}
        if not wanted:
            raise ValueError(
                "no submission defines a function of an exercise; name exercises or chapters to mark zeros"
            )
    return tuple(e.name for e in every.values() if e.name in names or e.chapter in wanted)


def grade(
    submissions: Sequence[Submission],
    grading: Grading,
    *,
    jobs: int = 0,
    tell: Callable[[str], None] = lambda line: None,
) -> list[Mark]:
    """The marks of all students, by student and in the order of the course.

    Args:
        submissions: Of each student.
        grading: What is marked, and how.
        jobs: Students at the same time; 0: one for each core, at most 8.
        tell: Gets a line for each student.

    Raises:
        NoSandbox: this system cannot run submissions in a sandbox.
    """
    check_possible()
    marks: dict[int, list[Mark]] = {}
    left = list(range(len(submissions)))
    n_jobs = min(jobs or min(usable_cores(), 8), len(submissions))
    environment = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "GSFUSION_BACKEND": "reference"}
    folder = tempfile.TemporaryDirectory(prefix="gsnb-class-", ignore_cleanup_errors=True)
    environment["TMPDIR"] = folder.name  # the clean copies of ended workers go with it
    with folder, WorkerPool(_grade_one, n_jobs, environment) as pool:
        while left or pool.running:
            while left and pool.has_room:
                i = left.pop(0)
                pool.start(i, (submissions[i], grading))
            for i, result in pool.wait():
                got = result if isinstance(result, list) else _not_graded(submissions[i], grading, result is Died)
                marks[i] = got
                total, most = sum(m.points for m in got), sum(m.most for m in got)
                tell(f"{len(marks)} of {len(submissions)}: {submissions[i].student}: {total:g} of {most:g} points")
    return [mark for i in sorted(marks) for mark in marks[i]]


def _grade_one(submission: Submission, grading: Grading) -> list[Mark]:
    """In a worker process."""
    codes = [read_code(file) for file in submission.files]
    chosen = {name: choose(codes, name, exercises()[name].chapter) for name in grading.names}
    cells = {name: code.cells for name, code in chosen.items() if code is not None}
    found = verdicts(cells, grading.seed, grading.limits)
    problems = [code.problem for code in codes if code.problem]
    files = ", ".join(code.file.name for code in codes) or "the submission"
    marks = []
    for name in grading.names:
        most = grading.points.of(exercises()[name])
        mark = Mark(student=submission.student, exercise=name, points=0.0, most=most)
        if name not in found:
            message = problems[0] if problems else f"there is no function {name} in {files}"
            mark = replace(mark, prop="it is submitted", message=message)
        elif found[name]:
            mark = replace(mark, points=most)
        else:
            prop, message = why(found[name])
            mark = replace(mark, prop=prop, message=message)
        marks.append(mark)
    return marks


def _not_graded(submission: Submission, grading: Grading, died: bool) -> list[Mark]:
    message = f"the grader {'ended' if died else 'failed'} while it judged this submission: mark it by hand"
    return [
        Mark(student=submission.student, exercise=name, points=0.0, most=grading.points.of(exercises()[name]),
             prop="it can be judged", message=message)
        for name in grading.names
    ]  # fmt: skip


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


def rubric_page(names: Sequence[str], points: Points) -> str:
    """HTML: the points of each exercise and the properties that an answer must have."""
    every = exercises()
    chapters: dict[int, list[Any]] = {}
    for name in names:
        exercise = every[name]
        about = {"name": name, "title": exercise.title, "minutes": exercise.minutes}
        about |= {"points": f"{points.of(exercise):g}", "difficulty": DIFFICULTIES[exercise.difficulty]}
        chapters.setdefault(exercise.chapter, []).append(about | {"properties": properties(exercise)})
    total = sum(points.of(every[name]) for name in names)
    titled = [{"number": n, "title": TITLES[n], "exercises": chapters[n]} for n in chapters]
    return fill("rubric.html", chapters=titled, total=f"{total:g}")
