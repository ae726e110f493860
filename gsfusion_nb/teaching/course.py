"""How far a learner is: exercises solved and predictions made, by chapter."""

from dataclasses import asdict, dataclass

from ..drawing.html import fill
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
}


@dataclass(frozen=True, kw_only=True)
class Chapter:
    """One chapter's exercises."""

    number: int
    title: str
    solved: int
    total: int
    open_exercises: tuple[str, ...]
    minutes_left: int
    """For the exercises that are open, as the course estimates it."""

    def __str__(self) -> str:
        rest = f", next: {self.open_exercises[0]}" if 0 < self.solved < self.total else ""
        return f"{self.number:2}  {self.title:28}{'#' * self.solved:<7} {self.solved} of {self.total} exercises{rest}"


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
    def percent(self) -> int:
        """Of all exercises."""
        return round(100 * self.done / self.total)

    @property
    def here(self) -> str:
        """One line about the notebook's chapter."""
        for chapter in self.chapters:
            if chapter.number == self.chapter:
                rest = f"open: {', '.join(chapter.open_exercises)}" if chapter.open_exercises else "all are solved"
                return f"This chapter: {chapter.solved} of {chapter.total} exercises solved; {rest}."
        return ""

    @property
    def whole(self) -> str:
        """One line about the course."""
        if self.problem:
            return f"Your progress is not known: {self.problem}"
        made = f"{self.predictions} prediction{'' if self.predictions == 1 else 's'} made"
        return f"Course: {self.done} of {self.total} exercises solved, {made}. All chapters: gsfusion-nb course"

    def __repr__(self) -> str:
        return "\n".join(line for line in (self.here, self.whole) if line)

    def _repr_html_(self) -> str:
        return fill("course.html", course=self)

    def as_table(self) -> str:
        """All chapters, one a line."""
        minutes = sum(chapter.minutes_left for chapter in self.chapters)
        last = f"{self.done} of {self.total} exercises, {self.predictions} predictions; about {minutes / 60:.0f} h left"
        return "\n".join([*map(str, self.chapters), "", last, *([f"kept in {self.file}"] if self.file else [])])

    def as_json(self) -> dict[str, object]:
        """For programs."""
        chapters = [asdict(chapter) for chapter in self.chapters]
        return {"file": self.file, "solved": self.done, "total": self.total, "predictions": self.predictions,
                "chapters": chapters}  # fmt: skip


def read_course(chapter: int | None = None) -> Course:
    """Progress over all chapters.

    Raises:
        CourseFileError: the file is damaged or newer.
    """
    made = sum("answer" in entry for entry in read_section("predictions").values())
    path = course_file()
    return Course(
        chapters=_chapters(read_section("exercises")), predictions=made, file=str(path) if path else "", chapter=chapter
    )


def course_progress(chapter: int) -> Course:
    """What a notebook shows at its top; a file that cannot be read is said in one line."""
    try:
        return read_course(chapter)
    except CourseFileError as e:
        return Course(chapters=_chapters({}), predictions=0, file="", problem=str(e))


def _chapters(noted: Entries) -> tuple[Chapter, ...]:
    """Every chapter, with what is noted about its exercises."""
    chapters = []
    every = exercises().values()
    for number in sorted({e.chapter for e in every}):
        own = [e for e in every if e.chapter == number]
        left = [e for e in own if "passed" not in noted.get(e.name, {})]
        chapters.append(
            Chapter(
                number=number,
                title=TITLES.get(number, f"Chapter {number}"),
                solved=len(own) - len(left),
                total=len(own),
                open_exercises=tuple(e.name for e in left),
                minutes_left=sum(e.minutes for e in left),
            )
        )
    return tuple(chapters)
