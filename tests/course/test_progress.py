"""Progress is one file: it grows, and is never lost."""

import json

import pytest

from gsfusion_nb.course import progress
from gsfusion_nb.course.progress import CourseFileError, course_file, note, read_section, reset


@pytest.fixture(autouse=True)
def course(tmp_path, monkeypatch):
    path = tmp_path / "folder" / "course.json"
    monkeypatch.setenv("GSNB_COURSE_FILE", str(path))
    monkeypatch.setattr(progress, "_messages", set())
    return path


def test_notes_are_merged_and_unknown_sections_kept(course):
    assert read_section("exercises") == {}
    course.parent.mkdir()
    course.write_text(json.dumps({"format": 1, "functions": {"f": {"source": "def f(): ..."}}}))
    note("exercises", "psnr", passed="today")
    note("exercises", "psnr", tries=2)
    assert read_section("exercises") == {"psnr": {"passed": "today", "tries": 2}}
    assert read_section("functions") == {"f": {"source": "def f(): ..."}}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('{"format": 1, "exerci', "cannot be read"),
        ("[]", "cannot be read"),
        ('{"format": 2}', "a newer version wrote it"),
        ("{}", "format None"),
    ],
)
def test_a_damaged_or_newer_file_is_left_as_it_is(course, text, says, capsys):
    course.parent.mkdir()
    course.write_text(text)
    with pytest.raises(CourseFileError, match=says):
        read_section("exercises")
    with pytest.raises(CourseFileError, match=says):
        note("exercises", "psnr", tries=1)
    for _ in range(2):
        with progress.forgiving():
            note("exercises", "psnr", tries=1)
    assert capsys.readouterr().out.count("Your progress is not kept") == 1
    assert course.read_text() == text
    kept = reset()
    assert kept is not None
    assert kept.read_text() == text
    assert read_section("exercises") == {}


def test_a_folder_that_cannot_be_written_is_said(course, monkeypatch):
    course.parent.mkdir()
    (course.parent / "file").write_text("")
    monkeypatch.setenv("GSNB_COURSE_FILE", str(course.parent / "file" / "course.json"))
    with pytest.raises(CourseFileError, match="cannot be written"):
        note("exercises", "psnr", tries=1)


def test_a_stored_notebook_keeps_no_file(monkeypatch):
    monkeypatch.delenv("GSNB_COURSE_FILE")
    monkeypatch.setenv("GSNB_VIEW", "static")
    monkeypatch.setattr(progress, "_in_memory", {"format": 1})
    assert course_file() is None
    note("exercises", "psnr", tries=1)
    assert read_section("exercises") == {"psnr": {"tries": 1}}
    assert reset() is None
    assert read_section("exercises") == {}
