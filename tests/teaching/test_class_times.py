"""The times of a class: quartiles, attempts, files that cannot be used, and the syllabus made of them."""

import json

import pytest

from gsfusion_nb.cli import main
from gsfusion_nb.teaching import clock, exercises, progress
from gsfusion_nb.teaching.kit.class_times import class_rows, read_learners
from gsfusion_nb.teaching.kit.syllabus import Times, weeks_table


def learner(minutes, *, robot=False, shown=""):
    """A course file in which chapter 0 is solved, each exercise in so many minutes, with the third attempt."""
    names = [e.name for e in exercises().values() if e.chapter == 0]
    noted = {name: {"tries": 7, "passed_at_try": 3, "passed": "2026-01-02T10:00:00"} for name in names}
    if shown:
        noted["psnr"]["solution_shown"] = shown
    times = {name: {"seconds": 60.0 * minutes, "gaps_s": [480, 2000]} for name in [*names, "chapter 0"]}
    return {"format": 1, "exercises": noted, "times": {**times, "clock": {"robot": True} if robot else {}}}


@pytest.fixture
def folder(tmp_path):
    files = tmp_path / "class"
    files.mkdir()
    for i, minutes in enumerate((4, 8, 12, 16)):
        course = learner(minutes, shown="2026-01-01T10:00:00" if i == 0 else "2026-01-03T10:00:00")
        (files / f"{i}.json").write_text(json.dumps(course))
    old = learner(0)
    del old["times"]
    (files / "old.json").write_text(json.dumps(old))
    (files / "copy.json").write_text((files / "0.json").read_text())
    (files / "damaged.json").write_text('{"format": 1, "exer')
    (files / "other.json").write_text('{"cells": []}')
    (files / "robot.json").write_text(json.dumps(learner(1, robot=True)))
    return files


def test_quartiles_attempts_and_unfolded_solutions(folder):
    learners, problems = read_learners([folder])
    assert len(learners) == 6
    for name, says in (("0.json", "is the same as"), ("damaged.json", "cannot be read"), ("other.json", "format None")):
        assert [name in problem and says in problem for problem in problems].count(True) == 1, (name, problems)
    rows = {row.name: row for row in class_rows([a for a in learners if not a.robot])}
    psnr = rows["psnr"]
    assert (psnr.n, psnr.untimed, psnr.median_tries, psnr.solution_share) == (4, 1, 3, 1 / 5)
    assert (psnr.lower_quartile_min, psnr.median_min, psnr.upper_quartile_min) == (8 + 7, 8 + 10, 8 + 13)
    assert psnr.measured is None  # four are not enough
    assert rows["Quickstart"].n == 4
    assert rows["slope"].median_min is None
    longer = {row.name: row for row in class_rows([a for a in learners if not a.robot], 3600.0)}
    assert longer["psnr"].median_min == pytest.approx(18 + 2000 / 60)


def test_the_command_writes_table_and_syllabus(folder, capsys):
    out = folder.parent
    page, table = out / "syllabus.md", out / "class.csv"
    assert main(["course", "times", str(folder), "--syllabus", str(page)]) == 0
    shown = capsys.readouterr()
    assert "5 learners; a gap of more than 10 minutes" in shown.out
    assert max(map(len, shown.out.splitlines()[:-1])) <= 80
    assert "typed by a program" in shown.err
    assert "damaged.json" in shown.err
    assert "Nothing here is measured yet" in page.read_text()
    (folder / "fifth.json").write_text(json.dumps(learner(20)))
    assert main(["course", "times", str(folder), "--syllabus", str(page), "--csv", str(table)]) == 0
    text = page.read_text()
    assert "**0 Quickstart** | 5 | 16.0 | 20.0 | 24.0 |" in text
    assert "≈ 69 (2 of 5 measured)" in text  # 20 + 20, and estimates of chapter 1
    assert "`psnr` | 5 |" in text
    assert "## Week by week" in text
    assert "exercise,psnr,0,5,1,16.0,20.0,24.0,3" in table.read_text()
    assert main(["course", "times", str(folder / "robot*.json")]) == 0  # Windows does not expand it
    assert "1 ROBOT, no learner" in capsys.readouterr().out
    assert main(["course", "times", str(folder / "robot.json"), "--syllabus", str(page)]) == 1
    assert page.read_text() == text
    assert main(["course", "times", str(folder / "other.json")]) == 1
    assert main(["course", "times", str(folder / "none")]) == 1
    assert "does not exist; expected course files" in capsys.readouterr().err


def test_sums_say_what_is_measured():
    assert Times({}).exercises(["psnr"]) == Times({"psnr": 9.0}).exercises(["psnr"]) == "9"
    assert Times({"psnr": 9.0}).exercises(["slope"]) == "≈ 5"
    assert "≈" not in weeks_table()


def test_what_is_shared_has_no_code_and_no_dates(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("GSNB_COURSE_FILE", str(tmp_path / "course.json"))
    (tmp_path / "course.json").write_text(json.dumps(learner(12, shown="2026-01-01T10:00:00")))
    progress.note("functions", "psnr", source="def psnr(): secret")
    clock.switch("off")
    assert main(["course", "--share", str(tmp_path / "shared.json")]) == 0
    text = (tmp_path / "shared.json").read_text()
    assert "secret" not in text
    assert "2026" not in text
    (shared,), problems = read_learners([tmp_path / "shared.json"])
    (whole,), _ = read_learners([tmp_path / "course.json"])
    assert problems == []
    assert class_rows([shared]) == class_rows([whole])
    assert main(["course", "--reset", "--yes"]) == 0
    assert clock.switched_off()
    assert "3 exercises, nothing else" in capsys.readouterr().out
