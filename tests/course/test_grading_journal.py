"""A grading that is stopped loses nothing, and goes on where it was."""

import csv
import time
from pathlib import Path

import pytest

from gsfusion_nb.cli import grade as command
from gsfusion_nb.course.grading import grade as module
from gsfusion_nb.course.grading.grade import grade
from gsfusion_nb.course.grading.journal import Journal
from gsfusion_nb.course.grading.judge import Limits
from gsfusion_nb.course.grading.submission import find_submissions
from gsfusion_nb.course.verdict import Verdict
from gsfusion_nb.errors import ArgumentError

NAMES = ("block_of", "zero_crossing")
STUDENTS = ("ann", "bob", "eve")


@pytest.fixture
def judged(monkeypatch):
    """What is judged, in place of judging it; after ``judged.limit`` functions the program is
    ended."""

    class Judged(list):
        limit = 100

    calls = Judged()

    def verdict(self, item):
        if len(calls) == calls.limit:
            raise KeyboardInterrupt
        calls.append((item.student, item.exercise))
        return Verdict(exercise=item.exercise, state="passed")

    monkeypatch.setattr(module._Judges, "verdict", verdict)
    monkeypatch.setattr(module, "copy_library", lambda folder: folder)
    return calls


def submit(folder: Path) -> None:
    folder.mkdir()
    for name in STUDENTS:
        text = f"def block_of(a, b): return {name!r}\ndef zero_crossing(a, b, c, d): return a\n"
        (folder / f"{name}.py").write_text(text)


def rows(path: Path) -> list[list[str]]:
    return [row[:3] for row in csv.reader(path.read_text().splitlines())][1:]


def mark(folder: Path, out: Path, **changes) -> None:
    options = command.GradeOptions(
        submissions=(folder,), exercises=NAMES, out=out, jobs=1, **changes
    )
    command.run(options)


def test_a_grading_that_is_stopped_goes_on(tmp_path, judged, capsys):
    submit(tmp_path / "class")
    out = tmp_path / "marks.csv"
    judged.limit = 3
    with pytest.raises(KeyboardInterrupt):
        mark(tmp_path / "class", out)
    assert len(rows(out)) == 3
    assert rows(out) == sorted(rows(out))
    judged.limit = 100
    journal = tmp_path / "marks.csv.journal"
    with journal.open("a") as file:
        file.write('{"key": "abc", "mark": {"stu')  # killed while it wrote
    mark(tmp_path / "class", out)
    assert len(judged) == 6  # none twice
    assert rows(out) == [[s, e, p] for s in STUDENTS for e, p in zip(NAMES, "12", strict=True)]
    assert "3 marks are known" in capsys.readouterr().out


def test_what_changed_is_marked_again(tmp_path, judged):
    submit(tmp_path / "class")
    out = tmp_path / "marks.csv"
    mark(tmp_path / "class", out)
    judged.clear()
    with (tmp_path / "class" / "bob.py").open("a") as file:
        file.write("# one more line\n")
    mark(tmp_path / "class", out)
    assert judged == [("bob", "block_of"), ("bob", "zero_crossing")]
    judged.clear()
    mark(tmp_path / "class", out, seconds=3.0)  # other limits, other marks
    assert len(judged) == 6
    judged.clear()
    mark(tmp_path / "class", out, seconds=3.0, resume=False)
    assert len(judged) == 6
    assert len(list(tmp_path.glob("marks-*.csv"))) == 1  # the earlier ones are not lost


def test_marks_of_another_program_are_not_taken(tmp_path, judged, monkeypatch):
    submit(tmp_path / "class")
    submissions = find_submissions([tmp_path / "class"])
    journal = Journal(tmp_path / "journal")
    grade(submissions, NAMES, limits=Limits(), journal=journal)
    monkeypatch.setattr(module, "grader_digest", lambda: "a checker that was changed")
    grade(submissions, NAMES, limits=Limits(), journal=journal)
    assert len(judged) == 12


def busy_judge(exercise, cells, limits, library):
    """A judge that a submission keeps busy, if it is asked about block_of."""
    time.sleep(600 if exercise == "block_of" else 0)
    return Verdict(exercise=exercise, state="passed")


def astonished_judge(exercise, cells, limits, library):
    """A judge for whom the library refuses what a submission sent."""
    if exercise == "block_of":
        raise ArgumentError("a camera 0 pixels wide")
    return Verdict(exercise=exercise, state="passed")


def test_an_error_of_the_library_is_the_mark_of_one_function(tmp_path, monkeypatch):
    submit(tmp_path / "class")
    submissions = find_submissions([tmp_path / "class"])[:1]
    monkeypatch.setattr(module, "judge", astonished_judge)
    monkeypatch.setattr(module, "copy_library", lambda folder: folder)
    refused, passed = grade(submissions, NAMES, limits=Limits(), jobs=1)
    assert (refused.points, passed.points) == (0, 2)
    assert "a camera 0 pixels wide" in refused.message


def test_a_judge_that_is_kept_busy_is_replaced(tmp_path, monkeypatch):
    submit(tmp_path / "class")
    submissions = find_submissions([tmp_path / "class"])[:1]
    monkeypatch.setattr(module, "judge", busy_judge)
    monkeypatch.setattr(module, "copy_library", lambda folder: folder)
    monkeypatch.setattr(module, "_JUDGE_S", 2.0)
    busy, free = grade(submissions, NAMES, limits=Limits(seconds=1.0), jobs=1)
    assert (busy.points, free.points) == (0, 2)
    assert "busy for more than 3 s" in busy.message


def test_a_journal_that_is_none_is_refused(tmp_path):
    (tmp_path / "journal").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="line 1"):
        Journal(tmp_path / "journal").read()
