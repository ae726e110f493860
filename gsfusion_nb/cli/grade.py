"""``gsfusion-nb grade``: marks for a class."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..errors import ArgumentError


@dataclass(frozen=True, kw_only=True)
class GradeOptions:
    """Mark the submissions of a class: each function runs in a process of its own, without the
    solutions.

    Writes a table with a line for each exercise of each student: points, the property that failed,
    and a message."""

    submissions: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Notebooks and .py files, or folders of them. A file belongs to the student whom its
    sub-folder names, else to its own name."""
    out: Path = Path("marks.csv")
    """The table of marks."""
    chapters: tuple[int, ...] = ()
    """Chapters to mark. Default: those of which a submission has a function."""
    exercises: tuple[str, ...] = ()
    """Exercises to mark, by name; with chapters, in addition."""
    seconds: float = 120.0
    """For all calls of a function, on the clock; one call may take as long as in a notebook."""
    memory_mb: int = 4096
    """Of the process in which a student's functions run, with Python and torch (on Linux)."""
    jobs: int = 0
    """Students at the same time. 0: one for each core, at most 8."""


def run(options: GradeOptions) -> int:
    """The command. Exit status 0: the table is written, whatever the marks."""
    from ..course.grading.marks import exercises_of, grade, write_marks
    from ..course.grading.sandbox import Limits, why_no_bubblewrap
    from ..course.grading.submission import find_submissions

    if options.seconds <= 0 or options.memory_mb <= 0:
        raise ArgumentError("--seconds and --memory-mb must be positive")
    submissions = find_submissions(options.submissions)
    if not submissions:
        raise ArgumentError("no submissions; name notebooks, .py files, or folders of them")
    names = exercises_of(options.chapters, options.exercises, submissions)
    print(f"{len(submissions)} students, {len(names)} exercises")
    if why_no_bubblewrap():
        print(
            f"{why_no_bubblewrap()}: a function may change your files and use the network. See "
            "docs/teaching/grading.md"
        )
    limits = Limits(seconds=options.seconds, memory_mb=options.memory_mb)
    marks = grade(submissions, names, limits=limits, jobs=options.jobs, tell=print)
    write_marks(options.out, marks)
    print(f"Marks: {options.out}")
    return 0
