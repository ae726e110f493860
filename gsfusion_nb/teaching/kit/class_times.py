"""The times of a class: how long its learners worked, from their course files.

A lecturer collects the files that ``gsfusion-nb course --share FILE`` writes (or whole course files) in a folder;
``gsfusion-nb course times FOLDER`` gives for each chapter and exercise how many finished it, quartiles of their working
time, attempts, and how many unfolded the solution before they were done.
"""

import csv
import hashlib
import io
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ...files import write_file
from ..clock import CLOCK, PAUSE_S, SECTION, working_s
from ..course import MINUTES, TITLES
from ..exercise import exercises
from ..progress import CourseFileError, Entries, read_file
from .estimates import exercise_minutes

ENOUGH = 5
"""Learners whose times replace an estimate in the syllabus."""
FASTEST_S = 20.0
"""An exercise that is accepted faster was solved elsewhere, or run again from a solved notebook."""
SHARED = ("tries", "passed_at_try", "hints")
"""Numbers of an exercise that are handed on; code, predictions and dates are not."""


@dataclass(frozen=True)
class Learner:
    """One course file."""

    file: str
    exercises: Entries
    times: Entries

    @property
    def robot(self) -> bool:
        """The file says that a program typed the answers."""
        return "robot" in self.times.get(CLOCK, {})

    def solved(self, name: str) -> bool:
        """Whether the checker accepted this exercise."""
        return "passed" in self.exercises.get(name, {})

    def unfolded(self, name: str) -> bool:
        """Whether the solution was shown before the exercise was solved, or without its being solved."""
        entry = self.exercises.get(name, {})
        if "solution_first" in entry:
            return entry["solution_first"] is True
        shown, passed = entry.get("solution_shown"), entry.get("passed")
        return isinstance(shown, str) and not (isinstance(passed, str) and passed < shown)


@dataclass(frozen=True, kw_only=True)
class Row:
    """What a class needed for one chapter or exercise. Minutes are of working time; ``None`` where nobody has one."""

    kind: str
    name: str
    chapter: int
    n: int
    """Learners who finished it and were timed."""
    untimed: int
    """Learners who finished it without a usable time."""
    lower_quartile_min: float | None
    median_min: float | None
    upper_quartile_min: float | None
    median_tries: float | None
    solution_share: float | None
    """Of those who tried it, how many unfolded the solution before they had solved it."""
    estimate_min: int

    @property
    def measured(self) -> float | None:
        """The median, if enough learners stand behind it."""
        return self.median_min if self.n >= ENOUGH else None


def read_learners(paths: Iterable[Path]) -> tuple[list[Learner], list[str]]:
    """The learners of files and folders, and a sentence for each file that is not used.

    Raises:
        FileNotFoundError: no such file or folder.
    """
    found: list[Path] = []
    for path in [each for given in paths for each in _matching(given)]:
        if not path.exists():
            raise FileNotFoundError(f"{path} does not exist; expected course files, or a folder of them")
        found += sorted(p for p in path.rglob("*.json") if p.is_file()) if path.is_dir() else [path]
    learners, problems, seen = [], [], dict[str, Path]()
    for path in found:
        try:
            course = read_file(path)
        except (CourseFileError, ValueError) as e:
            problems.append(f"not used: {e}")
            continue
        content = hashlib.sha256(repr(sorted(course.items())).encode()).hexdigest()
        if content in seen:
            problems.append(f"not used: {path} is the same as {seen[content]}")
        elif not course.get("exercises"):
            problems.append(
                f"not used: {path} holds no exercise; expected what  gsfusion-nb course --share FILE  writes"
            )
        else:
            learners.append(Learner(str(path), course["exercises"], course.get(SECTION, {})))
        seen.setdefault(content, path)
    return learners, problems


def _matching(path: Path) -> list[Path]:
    """The path itself; or what it matches, as ``class\\*.json``, which the shell of Windows leaves as it is."""
    if path.exists() or not any(sign in path.name for sign in "*?"):
        return [path]
    return sorted(path.parent.glob(path.name)) or [path]


def shared(exercise_notes: Entries, times: Entries) -> dict[str, Any]:
    """A course file for the lecturer: times, attempts and hints; no code, no predictions, no dates."""
    out: Entries = {}
    for name, entry in exercise_notes.items():
        out[name] = {key: entry[key] for key in SHARED if key in entry}
        if "passed" in entry:
            out[name]["passed"] = "yes"
        if "solution_shown" in entry:
            out[name]["solution_first"] = Learner("", {name: entry}, {}).unfolded(name)
    kept = {name: entry for name, entry in times.items() if name != CLOCK}
    robot = {"robot": times[CLOCK]["robot"]} if "robot" in times.get(CLOCK, {}) else {}
    return {"format": 1, "exercises": out, SECTION: {**kept, CLOCK: robot}}


def class_rows(learners: Sequence[Learner], pause_s: float = PAUSE_S) -> list[Row]:
    """A row for each chapter, followed by those of its exercises."""
    every = exercises().values()
    rows = []
    for chapter in sorted({e.chapter for e in every}):
        own = [e for e in every if e.chapter == chapter]
        names = [e.name for e in own]
        done = [a for a in learners if all(a.solved(name) for name in names)]
        about = {"kind": "chapter", "name": TITLES.get(chapter, ""), "chapter": chapter}
        rows.append(_row(about, done, f"chapter {chapter}", pause_s, MINUTES.get(chapter, 0), FASTEST_S * len(own)))
        for e in own:
            about = {"kind": "exercise", "name": e.name, "chapter": chapter}
            done = [a for a in learners if a.solved(e.name)]
            tried = [a for a in learners if a.exercises.get(e.name, {}).get("tries", 0)]
            tries = [float(n) for a in done if (n := _tries(a.exercises[e.name]))]
            share = sum(a.unfolded(e.name) for a in tried) / len(tried) if tried else None
            rows.append(_row(about, done, e.name, pause_s, exercise_minutes(e.name), FASTEST_S, tries, share))
    return rows


def _row(
    about: dict[str, Any], done: list[Learner], entry: str, pause_s: float, estimate: int, fastest_s: float,
    tries: Sequence[float] = (), share: float | None = None,
) -> Row:  # fmt: skip
    seconds = [working_s(learner.times.get(entry, {}), pause_s) for learner in done]
    minutes = [s / 60 for s in seconds if s >= fastest_s]
    lower, middle, upper = _quartiles(minutes)
    return Row(
        **about, n=len(minutes), untimed=len(done) - len(minutes), lower_quartile_min=lower, median_min=middle,
        upper_quartile_min=upper, median_tries=statistics.median(tries) if tries else None, solution_share=share,
        estimate_min=estimate,
    )  # fmt: skip


def _quartiles(values: list[float]) -> tuple[float | None, float | None, float | None]:
    if not values:
        return None, None, None
    if len(values) == 1:
        return values[0], values[0], values[0]
    lower, middle, upper = statistics.quantiles(values, n=4, method="inclusive")
    return lower, middle, upper


def _tries(entry: dict[str, Any]) -> int:
    """Attempts until it was accepted; in files of earlier versions, all of them."""
    tries = entry.get("passed_at_try", entry.get("tries", 0))
    return tries if isinstance(tries, int) and tries > 0 else 0


def as_csv(rows: Iterable[Row]) -> str:
    """The rows with a head, for a spreadsheet; an empty cell where nothing is known."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    names = [field.name for field in fields(Row)]
    writer.writerow(names)
    for row in rows:
        values = [getattr(row, name) for name in names]
        writer.writerow(["" if v is None else round(v, 2) if isinstance(v, float) else v for v in values])
    return out.getvalue()


def as_text(rows: Iterable[Row]) -> str:
    """The rows for a terminal of 80 characters; minutes are quartiles and median."""
    head = f"{'minutes':30}{'n':>4}{'lower':>7}{'median':>7}{'upper':>7}{'tries':>6}{'solution':>9}{'estimate':>9}"
    return "\n".join([head, *map(_line, rows)])


def _line(row: Row) -> str:
    name = f"{row.chapter:2}  {row.name}" if row.kind == "chapter" else f"      {row.name}"
    quartiles = (row.lower_quartile_min, row.median_min, row.upper_quartile_min)
    minutes = "".join(f"{_shown(value, lambda v: f'{v:.1f}'):>7}" for value in quartiles)
    tries = _shown(row.median_tries, lambda v: f"{v:g}")
    share = _shown(row.solution_share, lambda v: f"{100 * v:.0f} %")
    return f"{name:30}{row.n:4}{minutes}{tries:>6}{share:>9}{row.estimate_min:9}"


def _shown(value: float | None, form: Callable[[float], str]) -> str:
    return "-" if value is None else form(value)


def write_csv(rows: Iterable[Row], path: Path) -> None:
    """``as_csv`` in a file, complete or not at all."""
    write_file(path, as_csv(rows))
