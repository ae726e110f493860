"""``gsfusion-nb grade``: marks for a class."""

import sys
from dataclasses import dataclass
from datetime import datetime
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
    """Of all processes of a function together, with Python and torch (on Linux)."""
    jobs: int = 0
    """Functions at the same time. 0: one for each core, at most 8."""
    resume: bool = True
    """Take the marks of a grading that was stopped, or of an earlier one, for functions that have
    not changed, from the file MARKS.csv.journal beside the table. --no-resume: mark all again."""


def run(options: GradeOptions) -> int:
    """The command. Exit status 0: the table is written, whatever the marks."""
    from ..course.grading.grade import grade
    from ..course.grading.journal import Journal
    from ..course.grading.judge import Limits
    from ..course.grading.marks import exercises_of, write_marks
    from ..course.grading.sandbox import why_no_bubblewrap
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
            f"{why_no_bubblewrap()}: a function may read and change your files, the solutions and "
            "other submissions too, and use the network. See docs/teaching/grading.md"
        )
    if not sys.platform.startswith("linux"):
        print("This system does not limit the memory of a function.")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    journal = Journal(options.out.with_name(f"{options.out.name}.journal"))
    if not options.resume or not journal.path.exists():
        for path in (options.out, journal.path):
            _set_aside(path)
    elif earlier := len(journal.read()):
        print(
            f"{earlier} marks are known from before ({journal.path}). They are taken where the "
            "code, the limits and this program have not changed; --no-resume: mark all again"
        )
    marks = grade(
        submissions,
        names,
        limits=Limits(seconds=options.seconds, memory_mb=options.memory_mb),
        jobs=options.jobs,
        journal=journal,
        tell=lambda line: print(line, flush=True),
        keep=lambda marks: write_marks(options.out, marks),
    )
    write_marks(options.out, marks)
    print(f"Marks: {options.out}")
    return 0


def _set_aside(path: Path) -> None:
    """Rename a file of an earlier grading, so that nothing is lost."""
    if not path.exists():
        return
    stamp = datetime.fromtimestamp(path.stat().st_mtime)
    kept = path.with_name(f"{path.stem}-{stamp:%Y%m%d-%H%M%S}{path.suffix}")
    path.rename(kept)
    print(f"The earlier {path.name} is kept as {kept}")
