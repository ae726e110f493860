"""The syllabus names every exercise, and the learning goals cover all of them."""

import re
from pathlib import Path

from gsfusion_nb.course import exercises
from gsfusion_nb.course.course import MINUTES

ROOT = Path(__file__).resolve().parents[2]


def test_every_exercise_is_in_the_weeks_once():
    page = (ROOT / "docs/teaching/syllabus.md").read_text(encoding="utf-8")
    weeks = page[page.index("## The weeks") : page.index("## Week by week")]
    named = re.findall(
        r"`(\w+)`", "".join(line for line in weeks.splitlines() if line.startswith("|"))
    )
    assert sorted(named) == sorted(exercises())


def test_one_number_for_each_chapter():
    """Its notebook and the README say what ``MINUTES`` says."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for path in sorted((ROOT / "notebooks").glob("[0-9][0-9]_*.ipynb")):
        n = int(path.name[:2])
        assert f"{MINUTES[n]} minutes with reading and exercises" in path.read_text(
            encoding="utf-8"
        ), path.name
        assert re.search(rf"`{path.stem}` \|.*\| {MINUTES[n]} min \|$", readme, re.MULTILINE), (
            path.name
        )
    (hours,) = map(int, re.findall(r"about\s+(\d+) hours of work in all", readme))
    assert hours == round(sum(MINUTES.values()) / 60)


def test_every_exercise_is_a_learning_goal_of_its_chapter():
    page = (ROOT / "docs/teaching/goals.md").read_text(encoding="utf-8")
    parts = re.split(r"^## Chapter (\d+), ", page, flags=re.M)[1:]
    goals = {
        int(n): set(re.findall(r"\(`(\w+)`\)$", text, re.M))
        for n, text in zip(
            parts[::2],
            parts[1::2],
            strict=True,
        )
    }
    for chapter in {e.chapter for e in exercises().values()}:
        assert goals.get(chapter) == {e.name for e in exercises().values() if e.chapter == chapter}
