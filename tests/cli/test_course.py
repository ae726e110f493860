"""``gsfusion-nb course``: progress by chapter, as JSON, and from the start again."""

import io
import json

import pytest

from gsfusion_nb.cli import main
from gsfusion_nb.teaching import progress


@pytest.fixture
def course_file(tmp_path, monkeypatch):
    monkeypatch.setenv("GSNB_COURSE_FILE", str(tmp_path / "course.json"))
    progress.note("exercises", "psnr", tries=2, passed="2026-01-01T10:00:00")
    progress.note("predictions", "seeds", answer=3)
    return tmp_path / "course.json"


def test_progress_by_chapter(course_file, capsys):
    assert main(["course"]) == 0
    shown = capsys.readouterr().out
    assert " 0  Quickstart" in shown
    assert "1 of 3 exercises, next: " in shown
    assert "1 predictions; about" in shown
    assert main(["course", "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert (values["solved"], values["predictions"], values["file"]) == (1, 1, str(course_file))
    assert "psnr" not in values["chapters"][0]["open_exercises"]
    assert len(values["chapters"]) == 12


def test_reset_asks_and_keeps_the_file(course_file, capsys, monkeypatch):
    text = course_file.read_text()
    for answer in ("", "no\n"):
        monkeypatch.setattr("sys.stdin", io.StringIO(answer))
        assert main(["course", "--reset"]) == 1
        assert "Nothing was changed" in capsys.readouterr().out
    assert course_file.read_text() == text
    monkeypatch.setattr("sys.stdin", io.StringIO("yes\n"))
    assert main(["course", "--reset"]) == 0
    kept = list(course_file.parent.glob("course-*.json"))
    assert [path.read_text() for path in kept] == [text]
    assert not course_file.exists()
    assert main(["course", "--reset", "--yes"]) == 0
    assert "There was no progress" in capsys.readouterr().out


def test_a_damaged_file_is_said(course_file, capsys):
    course_file.write_text("[")
    assert main(["course"]) == 1
    assert "It was left as it is. Rename it, or run  gsfusion-nb course --reset" in capsys.readouterr().err
