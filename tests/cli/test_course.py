"""``gsfusion-nb course``: the notebooks in a folder; progress by chapter, as JSON, and from the
start again."""

import json
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from gsfusion_nb.cli import grade, main
from gsfusion_nb.cli.course import quoted
from gsfusion_nb.course import progress
from gsfusion_nb.errors import ArgumentError

ROOT = Path(__file__).resolve().parents[2]


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
    assert "1 of 3 exercises  60 min" in shown
    assert "1 of 60 exercises, 1 prediction" in shown
    assert "next: exam_frames\n" in shown


def test_a_path_is_one_word_on_every_system():
    assert (
        quoted(r"C:\Users\me\my course\00.ipynb", windows=True)
        == r'"C:\Users\me\my course\00.ipynb"'
    )
    assert quoted("/home/me/my course/00.ipynb", windows=False) == "'/home/me/my course/00.ipynb'"


def test_reset_keeps_the_file(course_file, capsys):
    text = course_file.read_text()
    assert main(["course", "--reset"]) == 0
    kept = list(course_file.parent.glob("course-*.json"))
    assert [path.read_text() for path in kept] == [text]
    assert not course_file.exists()
    assert main(["course", "--reset"]) == 0
    assert "There was no progress" in capsys.readouterr().out


def test_reset_is_not_forgotten_where_a_folder_is_given(course_file, tmp_path, capsys):
    assert main(["course", str(tmp_path / "class"), "--reset", "--path", "short"]) == 0
    assert "The course starts again" in capsys.readouterr().out
    assert not course_file.exists()
    assert list((tmp_path / "class").glob("*.ipynb"))


@pytest.mark.parametrize("option", [["--open"], ["--for-class"], ["--path", "short"]])
def test_options_of_the_folder_need_one(course_file, capsys, option):
    assert main(["course", *option]) == 1
    assert f"{option[0]} needs the folder of the notebooks" in capsys.readouterr().err


def test_a_damaged_file_is_said(course_file, capsys):
    course_file.write_text("[")
    assert main(["course"]) == 1
    assert (
        "It was left as it is. Rename it, or run  gsfusion-nb course --reset"
        in capsys.readouterr().err
    )


def test_the_notebooks_in_a_folder(tmp_path, capsys):
    folder = tmp_path / "my course"
    assert main(["course", str(folder)]) == 0
    said = capsys.readouterr().out
    assert (
        f"The notebooks are in {folder}. To open the first one: jupyter lab "
        f"'{folder}/00_quickstart.ipynb'" in said
    )
    first = folder / "00_quickstart.ipynb"
    assert "BEGIN SOLUTION" not in first.read_text()
    first.write_text(first.read_text() + " ")
    mine = first.read_bytes()
    assert main(["course", str(folder)]) == 0
    assert first.read_bytes() == mine  # what was changed is kept
    assert main(["course", str(first)]) == 1
    assert "is a file; expected a folder for the notebooks" in capsys.readouterr().err
    assert dead_links(folder) == []
    assert (
        "documentation/seeding_lab.md"
        in (folder / "09_write_your_own_seeding_rule.ipynb").read_text()
    )


def test_the_short_path_is_one_notebook(tmp_path):
    assert main(["course", str(tmp_path), "--path", "short"]) == 0
    (path,) = tmp_path.glob("*.ipynb")
    assert path.name == "short_path.ipynb"
    assert "SOLUTION" not in path.read_text()
    assert dead_links(tmp_path) == []
    path.write_text("mine")
    assert main(["course", str(tmp_path), "--path", "short"]) == 0
    assert path.read_text() == "mine"


def dead_links(folder: Path) -> list[str]:
    """Links of notebooks and pages in a folder that lead to no file."""
    texts: list[tuple[Path, str]] = [(path, path.read_text()) for path in folder.rglob("*.md")]
    for path in folder.glob("*.ipynb"):
        for cell in json.loads(path.read_text())["cells"]:
            outputs = [
                output.get("data", {}).get("text/html", "") for output in cell.get("outputs", ())
            ]
            texts += [
                (path, "".join(text))
                for text in (*outputs, *([cell["source"]] * (cell["cell_type"] == "markdown")))
            ]
    found = [
        (path, link)
        for path, text in texts
        for link in re.findall(r'\]\(([^)\s#]+)|(?:href|src)="([^"#]+)', text)
    ]
    assert len(found) > 50
    relative = [
        (path, "".join(link))
        for path, link in found
        if not re.match(r"https?:|data:|mailto:|attachment:", "".join(link))
    ]
    return [f"{path.name}: {link}" for path, link in relative if not (path.parent / link).exists()]


@pytest.mark.ci
def test_the_wheel_holds_the_notebooks_and_the_licence(tmp_path):
    pytest.importorskip("setuptools", minversion="77", reason="setuptools >= 77 is not installed")
    source = tmp_path / "source"  # setuptools leaves a folder build
    source.mkdir()
    for name in (
        "pyproject.toml",
        "README.md",
        "LICENSE",
        "gsfusion_nb",
        "kernels",
        "notebooks",
        "docs",
    ):
        (source / name).symlink_to(ROOT / name)
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--no-deps",
        "--no-build-isolation",
        "-w",
        str(tmp_path),
        str(source),
    ]
    subprocess.run(command, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert wheel.name.endswith("-py3-none-any.whl")  # nothing to compile
    # with the short path
    assert sum(name.startswith("gsfusion_nb/notebooks/") for name in names) == 14
    assert "gsfusion_nb/docs/seeding_lab.md" in names  # what the notebooks link to
    assert any(name.endswith("/licenses/LICENSE") for name in names)
    assert "gsfusion_nb/kernels/project/numba.py" in names


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seconds": 0.0}, "--seconds and --memory-mb must be positive"),
        ({}, "no submissions; name notebooks, .py files, or folders of them"),
    ],
)
def test_grading_nothing_is_refused_with_a_sentence(options, message):
    with pytest.raises(ArgumentError, match=message):
        grade.run(grade.GradeOptions(**options))
