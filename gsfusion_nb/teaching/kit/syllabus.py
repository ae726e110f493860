"""Six weeks of the course, and how long they take: the tables of ``docs/teaching/syllabus.md``.

``python -m gsfusion_nb.teaching.kit.syllabus NOTEBOOKS PAGE`` renews the tables between the markers of the page.
"""

import argparse
import re
from dataclasses import dataclass
from pathlib import Path

from ...files import atomic_file
from ...strict_json import read_object
from ..course import TITLES
from ..exercise import Exercise, exercises

WORDS_PER_MINUTE = 200
"""A usual reading speed for technical text in a second language."""
LAB_MINUTES = 90
"""Of the supervised lab of a week."""
_MARKER = re.compile(r"(<!-- begin (\w+): written by make quiz -->\n).*?(<!-- end \2 -->)", re.DOTALL)


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


def words_of(notebook: Path) -> int:
    """Words of the text cells, without comments and solutions."""
    words = 0
    for cell in read_object(notebook, "a notebook")["cells"]:
        if cell["cell_type"] == "markdown":
            words += len(re.sub(r"<!--.*?-->", "", "".join(cell["source"]), flags=re.DOTALL).split())
    return words


def reading_minutes(notebooks: Path) -> dict[int, int]:
    """Minutes to read the text of each chapter once, by its number."""
    paths = sorted(notebooks.glob("[0-9][0-9]_*.ipynb"))
    return {int(path.name[:2]): round(words_of(path) / WORDS_PER_MINUTE) for path in paths}


def stated_minutes(notebook: Path) -> int:
    """What the chapter's first cell says about reading and exercises together."""
    first = "".join(read_object(notebook, "a notebook")["cells"][0]["source"])
    found = re.search(r"(\d+) minutes with reading and exercises", first)
    if found is None:
        raise ValueError(f"{notebook.name}: the first cell states no minutes")
    return int(found[1])


def weeks_table(notebooks: Path) -> str:
    """Chapters and exercises of each week, with the minutes that the exercises and the chapters state."""
    lines = ["| week | chapters | in the lab | minutes | homework | minutes | at home in all |"]
    lines.append("|---|---|---|---:|---|---:|---:|")
    every = exercises()
    says = {int(path.name[:2]): stated_minutes(path) for path in sorted(notebooks.glob("[0-9][0-9]_*.ipynb"))}
    for week in WEEKS:
        own = [e for e in every.values() if e.chapter in week.chapters]
        lab = [every[name] for name in week.lab]
        home = [e for e in own if e.name not in week.lab]
        chapters = ", ".join(f"{n} {TITLES[n]}" for n in week.chapters)
        row = [f"{week.number}. {week.title}", chapters, _names(lab), _sum(lab), _names(home), _sum(home)]
        row.append(str(sum(says[n] for n in week.chapters) - LAB_MINUTES))
        lines.append("| " + " | ".join(row) + " |")
    taken = {n for week in WEEKS for n in week.chapters}
    rest = [e for e in every.values() if e.chapter not in taken]
    for chapter in sorted({e.chapter for e in rest}):
        own = [e for e in rest if e.chapter == chapter]
        title = TITLES.get(chapter, f"Chapter {chapter}")
        lines.append(f"| own choice | {chapter} {title} | | | {_names(own)} | {_sum(own)} | {says[chapter]} |")
    return "\n".join(lines) + "\n"


def times_table(notebooks: Path) -> str:
    """Each chapter: words, minutes to read them, exercises and their minutes, and what the chapter says."""
    lines = [
        "| chapter | words | minutes to read | exercises | their minutes | the chapter says |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    every = exercises().values()
    reading = reading_minutes(notebooks)
    totals = [0, 0, 0, 0, 0]
    for path in sorted(notebooks.glob("[0-9][0-9]_*.ipynb")):
        n = int(path.name[:2])
        own = [e for e in every if e.chapter == n]
        row = [words_of(path), reading[n], len(own), sum(e.minutes for e in own), stated_minutes(path)]
        totals = [a + b for a, b in zip(totals, row, strict=True)]
        lines.append(f"| {n} {TITLES.get(n, '')} | " + " | ".join(f"{value:,}" for value in row) + " |")
    lines.append("| all | " + " | ".join(f"{value:,}" for value in totals) + " |")
    return "\n".join(lines) + "\n"


def renewed(page: str, notebooks: Path) -> str:
    """The page with its tables written again.

    Raises:
        ValueError: the page has no markers, or one of an unknown table.
    """
    tables = {"weeks": weeks_table(notebooks), "times": times_table(notebooks)}
    names = [match[2] for match in _MARKER.finditer(page)]
    if sorted(names) != sorted(tables):
        raise ValueError(f"the page must have the markers of the tables {', '.join(tables)}, it has {names}")
    return _MARKER.sub(lambda match: f"{match[1]}{tables[match[2]]}{match[3]}", page)


def _names(of: list[Exercise]) -> str:
    return ", ".join(f"`{e.name}`" for e in of)


def _sum(of: list[Exercise]) -> str:
    return str(sum(e.minutes for e in of))


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
