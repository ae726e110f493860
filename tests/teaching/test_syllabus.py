"""The syllabus adds up, and the learning goals cover every exercise."""

import re
from pathlib import Path

import pytest

from gsfusion_nb.teaching import exercises
from gsfusion_nb.teaching.kit import syllabus

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs/teaching/syllabus.md"
MINUTES_OF_DRIFT = 3
"""A few sentences more in a notebook do not make the table of times wrong."""


def numbers(table: str) -> dict[str, list[int]]:
    rows = [line.strip("|").split("|") for line in table.splitlines()[2:]]
    return {row[0].strip(): [int(cell.replace(",", "")) for cell in row[1:]] for row in rows}


def test_the_weeks_are_those_of_the_exercises():
    assert syllabus.weeks_table(ROOT / "notebooks") in PAGE.read_text(encoding="utf-8"), "run  make quiz"
    every = exercises()
    for week in syllabus.WEEKS:
        assert all(every[name].chapter in week.chapters for name in week.lab)
        minutes = sum(every[name].minutes for name in week.lab)
        assert 1.5 * minutes <= syllabus.LAB_MINUTES, (
            f"the exercises of the lab of week {week.number} do not fit into it"
        )


def test_the_times_are_those_of_the_notebooks():
    page = PAGE.read_text(encoding="utf-8")
    tables = re.findall(r"<!-- begin times.*?-->\n(.*?)<!--", page, re.DOTALL)
    stored = numbers(tables[0])
    today = numbers(syllabus.times_table(ROOT / "notebooks"))
    assert stored.keys() == today.keys(), "run  make quiz"
    for name, row in today.items():
        assert stored[name][2:] == row[2:], f"{name}: run  make quiz"
        assert abs(stored[name][1] - row[1]) <= MINUTES_OF_DRIFT * (1 if name != "all" else 12), f"{name}: make quiz"


def test_a_page_without_its_markers_is_refused():
    with pytest.raises(ValueError, match="markers"):
        syllabus.renewed("nothing", ROOT / "notebooks")


def test_every_exercise_is_a_learning_goal_of_its_chapter():
    page = (ROOT / "docs/teaching/goals.md").read_text(encoding="utf-8")
    parts = re.split(r"^## Chapter (\d+), ", page, flags=re.M)[1:]
    goals = {
        int(n): set(re.findall(r"\| `(\w+)` \|$", text, re.M)) for n, text in zip(parts[::2], parts[1::2], strict=True)
    }
    for chapter in {e.chapter for e in exercises().values()}:
        assert goals.get(chapter) == {e.name for e in exercises().values() if e.chapter == chapter}
