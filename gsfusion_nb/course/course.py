"""How far a learner is: exercises solved and predictions made, by chapter."""

from dataclasses import dataclass

from ..drawing.page import fill
from .exercise import exercises
from .progress import CourseFileError, Entries, course_file, read_section

TITLES = {
    0: "Quickstart",
    1: "Frames and cameras",
    2: "TSDF fusion",
    3: "Quadtree",
    4: "Splatting, forwards",
    5: "Splatting, backwards",
    6: "Online mapping",
    7: "RTG-SLAM",
    8: "Tracking",
    9: "A seeding rule of your own",
    10: "Backends and speed",
    11: "A real recording",
    12: "GPS-SLAM",
}

MINUTES = {
    0: 60,
    1: 95,
    2: 135,
    3: 120,
    4: 185,
    5: 210,
    6: 120,
    7: 110,
    8: 170,
    9: 150,
    10: 75,
    11: 115,
    12: 80,
}
"""Of each chapter, for somebody to whom the subject is new: an estimate of the authors, not timed.
The notebooks, the README and the syllabus say the same; tests compare them."""


@dataclass(frozen=True, kw_only=True)
class Chapter:
    """One chapter's exercises."""

    number: int
    title: str
    solved: int
    total: int
    open_exercises: tuple[str, ...]
    minutes: int
    """For all of the chapter, as the course estimates it."""

    @property
    def line(self) -> str:
        """Exercises and time in one line."""
        bar = f"{'#' * self.solved:<9}{self.solved} of {self.total} exercises"
        return f"{self.number:2}  {self.title:28}{bar} {self.minutes:3} min"


@dataclass(frozen=True, kw_only=True)
class Course:
    """All chapters, and what was predicted."""

    chapters: tuple[Chapter, ...]
    predictions: int
    file: str
    problem: str = ""
    """Why nothing is known, if the file cannot be read."""
    chapter: int | None = None
    """The chapter that a notebook shows."""

    @property
    def done(self) -> int:
        """Exercises solved."""
        return sum(chapter.solved for chapter in self.chapters)

    @property
    def total(self) -> int:
        """Exercises of the course."""
        return sum(chapter.total for chapter in self.chapters)

    @property
    def here(self) -> str:
        """One line about the notebook's chapter."""
        for chapter in self.chapters:
            if chapter.number == self.chapter:
                rest = (
                    f"open: {', '.join(chapter.open_exercises)}"
                    if chapter.open_exercises
                    else "all are solved"
                )
                return (
                    f"This chapter: {chapter.solved} of {chapter.total} exercises solved; {rest}."
                )
        return ""

    @property
    def whole(self) -> str:
        """One line about the course."""
        if self.problem:
            return f"Your progress is not known: {self.problem}"
        prediction_words = (
            f"{self.predictions} prediction{'' if self.predictions == 1 else 's'} made"
        )
        return (
            f"Course: {self.done} of {self.total} exercises solved, {prediction_words}. "
            "All chapters: gsfusion-nb course"
        )

    def __repr__(self) -> str:
        return "\n".join(line for line in (self.here, self.whole) if line)

    def _repr_html_(self) -> str:
        return fill("course.html", course=self)

    def as_table(self) -> str:
        """All chapters, one a line, and what is next."""
        of = sum(chapter.minutes for chapter in self.chapters) / 60
        prediction_words = f"{self.predictions} prediction{'' if self.predictions == 1 else 's'}"
        chapters = [
            chapter.open_exercises[0]
            for chapter in self.chapters
            if 0 < chapter.solved < chapter.total
        ]
        return "\n".join(
            [
                *(chapter.line for chapter in self.chapters),
                "",
                f"{self.done} of {self.total} exercises, {prediction_words}",
                f"about {of:.0f} h in all, text and panels included",
                *([f"next: {', '.join(chapters)}"] if chapters else []),
                *([f"kept in {self.file}"] if self.file else []),
            ]
        )


def read_course(chapter: int | None = None) -> Course:
    """Progress over all chapters.

    Raises:
        CourseFileError: the file is damaged or newer.
    """
    n_predictions = sum("answer" in entry for entry in read_section("predictions").values())
    path = course_file()
    chapters = _chapters(read_section("exercises"))
    return Course(
        chapters=chapters,
        predictions=n_predictions,
        file=str(path) if path else "",
        chapter=chapter,
    )


def course_progress(chapter: int) -> Course:
    """What a notebook shows at its top; a file that cannot be read is said in one line."""
    try:
        return read_course(chapter)
    except CourseFileError as e:
        return Course(
            chapters=_chapters({}),
            predictions=0,
            file="",
            problem=str(e),
        )


def _chapters(entries: Entries) -> tuple[Chapter, ...]:
    """Every chapter, with what is noted about its exercises."""
    chapters = []
    every = exercises().values()
    for number in sorted({e.chapter for e in every}):
        own = [e for e in every if e.chapter == number]
        open_exercises = [e for e in own if "passed" not in entries.get(e.name, {})]
        chapters.append(
            Chapter(
                number=number,
                title=TITLES.get(number, f"Chapter {number}"),
                solved=len(own) - len(open_exercises),
                total=len(own),
                open_exercises=tuple(e.name for e in open_exercises),
                minutes=MINUTES.get(number, 0),
            )
        )
    return tuple(chapters)
