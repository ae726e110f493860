"""The syllabus adds up, and the learning goals cover every exercise."""

import re
from pathlib import Path

import pytest

from gsfusion_nb.teaching import exercises
from gsfusion_nb.teaching.course import MINUTES, TITLES
from gsfusion_nb.teaching.kit import estimates, syllabus

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs/teaching/syllabus.md"
MINUTES_OF_DRIFT = 10
"""A few sentences or lines of code more in a notebook do not make what it says wrong."""


def numbers(table: str) -> dict[str, list[int]]:
    rows = [line.strip("|").split("|") for line in table.splitlines()[2:]]
    return {row[0].strip(): [int(cell.replace(",", "")) for cell in row[1:]] for row in rows}


def test_the_weeks_are_those_of_the_exercises():
    page = PAGE.read_text(encoding="utf-8")
    assert syllabus.weeks_table() in page, "run  make quiz"
    assert syllabus.rates_table() in page, "run  make quiz"
    every = exercises()
    for week in syllabus.WEEKS:
        assert all(every[name].chapter in week.chapters for name in week.lab)
        minutes = sum(estimates.exercise_minutes(name) for name in week.lab)
        assert minutes <= syllabus.LAB_MINUTES, f"the exercises of the lab of week {week.number} do not fit into it"


def test_one_number_for_each_chapter():
    """Its notebook, the README and the syllabus say what ``MINUTES`` says, and that is the estimate."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    page = PAGE.read_text(encoding="utf-8")
    stored = numbers(re.findall(r"<!-- begin times.*?-->\n(.*?)<!--", page, re.DOTALL)[0])
    for path in sorted((ROOT / "notebooks").glob("[0-9][0-9]_*.ipynb")):
        n = int(path.name[:2])
        assert f"{MINUTES[n]} minutes with reading and exercises" in path.read_text(encoding="utf-8"), path.name
        assert re.search(rf"`{path.stem}` \|.*\| {MINUTES[n]} min \|$", readme, re.MULTILINE), path.name
        estimate, row = estimates.chapter_minutes(path), stored[f"{n} {TITLES[n]}"]
        assert abs(estimate - MINUTES[n]) <= MINUTES_OF_DRIFT, f"{path.name}: about {estimate} minutes; make quiz"
        assert abs(row[5] + row[7] - estimate) <= MINUTES_OF_DRIFT, f"{path.name}: make quiz"
        assert (row[5] + row[7], row[9]) == (row[8], MINUTES[n])
    sums = [sum(row[i] for name, row in stored.items() if name != "all") for i in range(10)]
    assert sums == stored["all"]
    (hours,) = map(int, re.findall(r"about\s+(\d+) hours of work in all", readme))
    assert hours == round(sum(MINUTES.values()) / 60)


def test_exercises_state_what_is_plausible():
    """Their own minutes are for somebody who knows how to begin: not more than a third above the estimate for one who
    does not, and not less than its half, or three minutes beside it."""
    every = exercises().values()
    wrong = {
        e.name: (e.minutes, minutes)
        for e in every
        if abs(e.minutes - (minutes := estimates.exercise_minutes(e.name))) > 3
        if not minutes / 2 <= e.minutes <= 4 / 3 * minutes
    }
    assert wrong == {}


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
