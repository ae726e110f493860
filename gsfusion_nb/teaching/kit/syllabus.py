"""Six weeks of the course, and how long they take: the tables of ``docs/teaching/syllabus.md``.

``python -m gsfusion_nb.teaching.kit.syllabus NOTEBOOKS PAGE`` renews the parts between the markers of the page, with
estimates (``estimates.py``). ``gsfusion-nb course times FILES --syllabus PAGE`` writes a copy with the times of a class
in their place where enough learners stand behind them.
"""

import argparse
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ...files import atomic_file
from ..course import MINUTES, TITLES
from ..exercise import exercises
from .class_times import ENOUGH, Row
from .estimates import RATES, chapter_minutes, counts_of, exercise_minutes, exercises_minutes

LAB_MINUTES = 90
"""Of the supervised lab of a week."""
_MARKER = re.compile(r"(<!-- begin (\w+): written by make quiz -->\n).*?(<!-- end \2 -->)", re.DOTALL)

_ABOUT_ESTIMATES = """\
All minutes are **estimates**, for somebody to whom the subject is new; [below](#how-the-times-come-about) is how they
come about. "At home in all" is what the chapters take less the 90 minutes of the lab: reading, predictions, panels and
homework, without what is to be handed in beside the exercises.
"""
_ABOUT_MEASURED = """\
A number is a **median of {learners} learners** of a class where at least {enough} of them finished the exercise and
were timed; gaps of more than {pause:g} minutes count as pauses. **≈** marks a sum that holds estimates. "At home in
all" is what the chapters take less the 90 minutes of the lab, without what is to be handed in beside the exercises.
"""
_BARE_PAGE = "# Syllabus: six weeks, with the times of a class\n\n" + "\n".join(
    f"<!-- begin {name}: written by make quiz -->\n<!-- end {name} -->\n" for name in ("weeks", "about", "times")
)
"""Where the documentation is not installed."""


@dataclass(frozen=True)
class Week:
    """One week: its chapters, and the exercises that are solved in the supervised lab; the others are homework."""

    number: int
    title: str
    chapters: tuple[int, ...]
    lab: tuple[str, ...]


WEEKS = (
    Week(1, "One frame", (0, 1), ("exam_frames", "first_seen", "project_points", "lift_pixels", "invert_pose")),
    Week(
        2, "A surface, and how many Gaussians", (2, 3), ("signed_distance", "running_average", "block_of", "contrast")
    ),
    Week(3, "From Gaussians to a picture", (4,), ("covariance_2d", "composite_pixel", "tiles_touched")),
    Week(4, "From a picture to gradients", (5,), ("slope", "l1_gradient", "blend_vjp", "inverse_vjp")),
    Week(5, "Two systems", (6, 7), ("plan_frame", "draw_keyframes", "map_frame", "disc_hit", "adding_masks")),
    Week(6, "Poses, and rules of your own", (8, 9), ("point_to_plane", "gauss_newton", "predict", "raster_rule")),
)


@dataclass(frozen=True)
class Times:
    """Minutes of exercises and chapters: medians of a class where it was measured, estimates elsewhere."""

    measured: Mapping[str, float]
    """By name of an exercise, or ``chapter N``."""

    def exercises(self, names: Sequence[str]) -> str:
        """The sum over some exercises."""
        return self._sum({name: exercise_minutes(name) for name in names})

    def chapters(self, numbers: Sequence[int], less: int = 0) -> str:
        """The sum over some chapters, less what is worked on in the lab."""
        return self._sum({f"chapter {n}": MINUTES[n] for n in numbers}, less)

    def _sum(self, estimates: Mapping[str, int], less: int = 0) -> str:
        total = max(round(sum(self.measured.get(name, minutes) for name, minutes in estimates.items())) - less, 0)
        known = sum(name in self.measured for name in estimates)
        if not self.measured or known == len(estimates):
            return str(total)
        return f"≈ {total}" if not known else f"≈ {total} ({known} of {len(estimates)} measured)"


def weeks_table(times: Times | None = None) -> str:
    """Chapters and exercises of each week, with their minutes."""
    times = times or Times({})
    lines = ["| week | chapters | in the lab | minutes | homework | minutes | at home in all |"]
    lines.append("|---|---|---|---:|---|---:|---:|")
    every = exercises().values()
    for week in WEEKS:
        home = [e.name for e in every if e.chapter in week.chapters and e.name not in week.lab]
        chapters = ", ".join(f"{n} {TITLES[n]}" for n in week.chapters)
        row = [f"{week.number}. {week.title}", chapters, _names(week.lab), times.exercises(week.lab), _names(home)]
        row += [times.exercises(home), times.chapters(week.chapters, LAB_MINUTES)]
        lines.append("| " + " | ".join(row) + " |")
    taken = {n for week in WEEKS for n in week.chapters}
    for chapter in sorted({e.chapter for e in every} - taken):
        own = [e.name for e in every if e.chapter == chapter]
        row = [f"own choice | {chapter} {TITLES.get(chapter, f'Chapter {chapter}')} | | | {_names(own)}"]
        lines.append("| " + " | ".join([*row, times.exercises(own), times.chapters((chapter,))]) + " |")
    return "\n".join(lines) + "\n"


def times_table(notebooks: Path) -> str:
    """Each chapter: what is counted, the minutes that follow, and what the chapter says."""
    lines = [
        "| chapter | words | lines of code | formulas | predictions | panels | minutes of these | exercises | "
        "their minutes | in all | the chapter says |",
        f"|---|{'---:|' * 10}",
    ]
    every = exercises().values()
    totals = [0] * 10
    for path in sorted(notebooks.glob("[0-9][0-9]_*.ipynb")):
        n, counts = int(path.name[:2]), counts_of(path)
        own, in_all = exercises_minutes(n), chapter_minutes(path)
        row = [counts.words, counts.code_lines, counts.formulas, counts.predictions, counts.panels, in_all - own]
        row += [sum(e.chapter == n for e in every), own, in_all, MINUTES[n]]
        totals = [a + b for a, b in zip(totals, row, strict=True)]
        lines.append(f"| {n} {TITLES.get(n, '')} | " + " | ".join(f"{value:,}" for value in row) + " |")
    lines.append("| all | " + " | ".join(f"{value:,}" for value in totals) + " |")
    return "\n".join(lines) + "\n"


def rates_table() -> str:
    """The rates behind the estimates, with their sources."""
    lines = ["| for each | minutes | how it is known |", "|---|---:|---|"]
    return "\n".join([*lines, *(f"| {r.what} | {r.minutes:.2g} | {r.known} |" for r in RATES)]) + "\n"


def class_table(rows: Sequence[Row]) -> str:
    """What a class needed, beside the estimates."""
    lines = ["| chapter, exercise | learners timed | lower quartile | median | upper quartile | tries | unfolded the "
             "solution | estimate |", f"|---|{'---:|' * 7}"]  # fmt: skip
    for row in rows:
        name = f"**{row.chapter} {row.name}**" if row.kind == "chapter" else f"`{row.name}`"
        minutes = (row.lower_quartile_min, row.median_min, row.upper_quartile_min)
        cells = [name, str(row.n), *("" if m is None else f"{m:.1f}" for m in minutes)]
        cells.append("" if row.median_tries is None else f"{row.median_tries:g}")
        cells.append("" if row.solution_share is None else f"{100 * row.solution_share:.0f} %")
        lines.append("| " + " | ".join([*cells, str(row.estimate_min)]) + " |")
    return "\n".join(lines) + "\n"


def renewed(page: str, notebooks: Path) -> str:
    """The page with its tables of estimates written again.

    Raises:
        ValueError: the page has no markers, or one of an unknown table.
    """
    return _replaced(
        page,
        {"weeks": weeks_table(), "about": _ABOUT_ESTIMATES, "times": times_table(notebooks), "rates": rates_table()},
    )


def measured_page(rows: Sequence[Row], learners: int, pause_min: float, page: Path | None = None) -> str:
    """The syllabus with the times of a class.

    Args:
        rows: Of ``class_rows``.
        learners: How many course files they are of.
        pause_min: Longer gaps counted as pauses.
        page: The syllabus with the estimates; without one only the tables are written.

    Raises:
        ValueError: the page has no markers, or one of an unknown table.
    """
    times = Times({
        f"chapter {row.chapter}" if row.kind == "chapter" else row.name: row.measured
        for row in rows
        if row.measured is not None
    })  # fmt: skip
    about = _ABOUT_MEASURED.format(learners=learners, enough=ENOUGH, pause=pause_min)
    if not times.measured:
        about += f"\nNothing here is measured yet: no exercise was finished by {ENOUGH} timed learners.\n"
    parts = {"weeks": weeks_table(times), "about": about, "times": class_table(rows)}
    if page is None:
        return _replaced(_BARE_PAGE, parts)
    return _replaced(page.read_text(encoding="utf-8"), {**parts, "rates": rates_table()})


def _replaced(page: str, parts: Mapping[str, str]) -> str:
    names = [match[2] for match in _MARKER.finditer(page)]
    if sorted(names) != sorted(parts):
        raise ValueError(f"the page must have the markers of the tables {', '.join(parts)}, it has {names}")
    return _MARKER.sub(lambda match: f"{match[1]}{parts[match[2]]}{match[3]}", page)


def _names(of: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in of)


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Renew the tables of the syllabus.")
    parser.add_argument("notebooks", type=Path)
    parser.add_argument("page", type=Path)
    options = parser.parse_args(arguments)
    text = renewed(options.page.read_text(encoding="utf-8"), options.notebooks)
    with atomic_file(options.page) as temporary:
        temporary.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
