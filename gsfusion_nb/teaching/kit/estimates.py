"""How long a chapter takes somebody to whom its subject is new, before anybody was timed: counts times rates.

minutes of an exercise = stars x TRY + lines of its solution x LINE + characters of its solution x KEY
minutes of a chapter   = words x WORD + lines of given code x CODE_LINE + displayed formulas x FORMULA
                         + predictions x PREDICTION + panels x PANEL + its exercises + computing

Rates with a source come from the literature; the others are the authors' guesses and say so. What a class needed takes
the place of all of them (``class_times.py``).
"""

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ...strict_json import read_object
from ..exercise import Exercise, exercises
from ..solution import source_of

GUESS = "a guess of the authors"


@dataclass(frozen=True)
class Rate:
    """Minutes that one of something takes, and how that is known."""

    what: str
    minutes: float
    known: str


WORD = Rate(
    "word of text", 1 / 167,
    "238 words a minute, silent reading of English non-fiction by adults (Brysbaert 2019, 190 studies), less 30 %, the "
    "loss of highly bilingual readers in their second language (Segalowitz, Poulsen & Komoda 1991)",
)  # fmt: skip
CODE_LINE = Rate(
    "line of given code", 60 / 500, "500 lines an hour, preparing a review of application code (Humphrey 1989)"
)
KEY = Rate(
    "character of a solution", 0.5 / 60,
    "0.5 s, typing random letters, between prose (0.28 s) and complex codes (0.75 s) (Card, Moran & Newell 1980)",
)  # fmt: skip
LINE = Rate("line of a solution: what it must be", 0.75, GUESS)
TRY = Rate("star of an exercise: a try, its verdict and a hint", 4.0, f"{GUESS}; as many tries as stars")
FORMULA = Rate("displayed formula", 1.0, GUESS)
PREDICTION = Rate("prediction", 1.0, GUESS)
PANEL = Rate("interactive panel", 3.0, GUESS)
RATES = (WORD, CODE_LINE, FORMULA, PREDICTION, PANEL, TRY, LINE, KEY)

COMPUTING_MINUTES = 1
"""Each chapter runs in under a minute on a quiet two-core machine, chapter 9 in three: measured."""
ROUNDED_TO = 5
"""Minutes: more digits would pretend."""

_DISPLAYED = re.compile(r"\$\$.+?\$\$", re.DOTALL)
_PREDICTION = re.compile(r"\*\*Predict\b")
_PANEL = re.compile(r"(?:_panel|LiveMapper|_stepper|SplatViewer|TracePanel|Microscope|LiveTable|LiveLoop|show_mesh)\(")
_IMPORT = re.compile(r"\s*(?:from |import |\)|    \w+,$)")


@dataclass(frozen=True, kw_only=True)
class Counts:
    """What a notebook holds for a learner: its unsolved edition."""

    words: int
    code_lines: int
    """Of given code, without imports and comments."""
    formulas: int
    predictions: int
    panels: int

    @property
    def reading(self) -> float:
        """Minutes for text, formulas and code."""
        return self.words * WORD.minutes + self.formulas * FORMULA.minutes + self.code_lines * CODE_LINE.minutes

    @property
    def trying(self) -> float:
        """Minutes for predictions and panels."""
        return self.predictions * PREDICTION.minutes + self.panels * PANEL.minutes


def counts_of(notebook: Path) -> Counts:
    """Counts of one notebook; comments in its text, and its solutions, do not count."""
    cells = read_object(notebook, "a notebook")["cells"]
    sources = [(cell["cell_type"], "".join(cell["source"])) for cell in cells]
    text = "\n".join(re.sub(r"<!--.*?-->", "", s, flags=re.DOTALL) for kind, s in sources if kind == "markdown")
    code = [s for kind, s in sources if kind == "code" and "BEGIN SOLUTION" not in s]
    lines = [line for source in code for line in source.splitlines() if line.strip() and not _IMPORT.match(line)]
    return Counts(
        words=len(text.split()),
        code_lines=sum(not line.lstrip().startswith("#") for line in lines),
        formulas=len(_DISPLAYED.findall(text)),
        predictions=len(_PREDICTION.findall(text)),
        panels=sum(len(_PANEL.findall(source)) for source in code),
    )


@cache
def exercise_minutes(name: str) -> int:
    """An estimate for one exercise."""
    exercise = exercises()[name]
    lines = _solution_lines(exercise)
    characters = sum(len(line) for line in lines)
    return round(exercise.difficulty * TRY.minutes + len(lines) * LINE.minutes + characters * KEY.minutes)


def exercises_minutes(chapter: int) -> int:
    """The sum over the exercises of a chapter."""
    return sum(exercise_minutes(e.name) for e in exercises().values() if e.chapter == chapter)


def chapter_minutes(notebook: Path) -> int:
    """An estimate for one chapter, its number being the first two digits of the file's name; not rounded to fives."""
    counts = counts_of(notebook)
    return round(counts.reading + counts.trying + COMPUTING_MINUTES) + exercises_minutes(int(notebook.name[:2]))


def _solution_lines(exercise: Exercise) -> list[str]:
    """Lines of the course's solution and what it calls, without comments, docstrings and first lines."""
    source = source_of(exercise.name, exercise._solution)
    body = re.sub(r'""".*?"""', "", source, flags=re.DOTALL).splitlines()
    lines = [line.strip() for line in body]
    return [line for line in lines if line and not line.startswith(("#", "@", "def ", ") ->"))]
