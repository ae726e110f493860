"""``gsfusion-nb grade``: marks for a class."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..config.values import parse_options


@dataclass(frozen=True, kw_only=True)
class GradeOptions:
    """Mark the submissions of a class: each function runs in a process of its own, without the solutions.

    Writes a table with a line for each exercise of each student: points, the property that failed, and a message."""

    submissions: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Notebooks and .py files, or folders of them. A file belongs to the student whom its sub-folder names, else to
    its own name; nbgrader's folder "submitted" is understood."""
    out: Path = Path("marks.csv")
    """The table of marks."""
    rubric: Path | None = None
    """Also write a page (HTML) that says the points and properties of each exercise. It is written without
    submissions, too, if chapters or exercises are named."""
    chapters: tuple[int, ...] = ()
    """Chapters to mark. Default: those of which a submission has a function."""
    exercises: tuple[str, ...] = ()
    """Exercises to mark, by name; with chapters, in addition."""
    points: Path | None = None
    """TOML file with points: [difficulty] 1 = 2.0, or [exercise] psnr = 4. Default: 1, 2, 3, 5 and 8 points for the
    difficulties 1 to 5."""
    seed: int = -1
    """Of the hidden inputs, the same for the whole class. Default: a new one, which is printed. Repeating a grading
    with its seed gives the same marks."""
    seconds: float = 30.0
    """Processor time for each function. More: slow answers pass, and endless ones are waited for longer."""
    memory_mb: int = 1024
    """Memory for each function, beyond what Python and torch take."""
    jobs: int = 0
    """Students at the same time. 0: one for each core, at most 8."""


def run(arguments: list[str]) -> int:
    """The command. Exit status 0: the table is written, whatever the marks."""
    from ..course.grading.marks import (
        Grading,
        Points,
        exercises_of,
        grade,
        new_seed,
        read_points,
        rubric_page,
        write_marks,
    )
    from ..course.grading.sandbox import Limits, unprotected
    from ..course.grading.submission import find_submissions
    from ..files import write_file

    options = parse_options(GradeOptions, prog="gsfusion-nb grade", arguments=arguments)
    if options.seconds <= 0 or options.memory_mb <= 0:
        raise ValueError("--seconds and --memory-mb must be positive")
    points = read_points(options.points) if options.points else Points()
    submissions = find_submissions(options.submissions)
    if not submissions and not (options.rubric and (options.chapters or options.exercises)):
        raise ValueError("no submissions; name notebooks, .py files, or folders of them")
    names = exercises_of(options.chapters, options.exercises, submissions)
    if options.rubric:
        write_file(options.rubric, rubric_page(names, points))
        print(f"Points and properties: {options.rubric}")
    if not submissions:
        return 0
    seed = options.seed if options.seed >= 0 else new_seed()
    print(
        f"{len(submissions)} students, {len(names)} exercises, seed {seed} (--seed {seed} gives the same inputs again)"
    )
    if unprotected():
        print(f"Take care: {unprotected()}")
    grading = Grading(
        names=names, points=points, seed=seed, limits=Limits(seconds=options.seconds, memory_mb=options.memory_mb)
    )
    marks = grade(submissions, grading, jobs=options.jobs, tell=print)
    write_marks(options.out, marks)
    print(f"Marks: {options.out}")
    return 0
