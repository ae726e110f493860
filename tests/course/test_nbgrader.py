"""A real run of nbgrader over six submissions, which get the marks that they deserve."""

import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from gsfusion_nb.cli.course import run as course
from gsfusion_nb.course.grading.export import assignment_cells, export_course

ROOT = Path(__file__).resolve().parents[2]
SUBMISSIONS = Path(__file__).parent / "submissions"
CHAPTER = "02_tsdf_fusion"
MARKS = {
    "right": 4,
    "partly_right": 2,
    "wrong_sign": 0,
    "endless": 2,
    "out_of_memory": 2,
    "raises": 2,
}
MOST = 4
NAMES = ("signed_distance", "zero_crossing")


def exported(tmp_path: Path) -> Path:
    """The two exercises of the chapter on which they differ, as an assignment."""
    target = tmp_path / "nbgrader"
    notebook = json.loads((ROOT / "notebooks" / f"{CHAPTER}.ipynb").read_text())
    of_both = re.compile(
        rf"^(def |check\.)({'|'.join(NAMES)})\(|from gsfusion_nb.course import", re.MULTILINE
    )
    notebook["cells"] = [c for c in notebook["cells"] if of_both.search("".join(c["source"]))]
    chapter = tmp_path / f"{CHAPTER}.ipynb"
    chapter.write_text(json.dumps(notebook))
    export_course([chapter], target)
    return target


def handed_in(released: Path, student: Path) -> str:
    """The released notebook with the functions of a made submission in its answer cells."""
    notebook = json.loads(released.read_text())
    source = student.read_text()
    body = ast.parse(source).body
    of = {
        n.name: ast.get_source_segment(source, n)
        for n in body
        if isinstance(n, ast.FunctionDef) and n.name in NAMES
    }
    rest = "\n".join(
        str(ast.get_source_segment(source, n)) for n in body if getattr(n, "name", "") not in NAMES
    )
    for cell in notebook["cells"]:
        text = "".join(cell["source"])
        found = re.search(r"^def (\w+)\(", text, re.MULTILINE)
        if cell["cell_type"] == "code" and found and found[1] in of:
            cell["source"] = f"{rest}\n\n\n{of[found[1]]}"
            rest = ""
    return json.dumps(notebook)


def run(*command: str, cwd: Path) -> None:
    programs = (
        f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"  # nbgrader calls alembic
    )
    environment = os.environ | {
        "OMP_NUM_THREADS": "1",
        "JUPYTER_PLATFORM_DIRS": "1",
        "PATH": programs,
    }
    done = subprocess.run(
        [sys.executable, "-m", *command],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]


@pytest.mark.ci
def test_nbgrader_gives_six_submissions_their_marks(tmp_path):
    pytest.importorskip(
        "nbgrader", reason='nbgrader is not installed: pip install "gsfusion-nb[teaching]"'
    )
    from nbgrader.api import Gradebook

    course = exported(tmp_path)
    run("nbgrader", "generate_assignment", CHAPTER, cwd=course)
    released = course / "release" / CHAPTER / f"{CHAPTER}.ipynb"
    assert "sdf_m = depth_m - z_m" not in released.read_text()
    for name in MARKS:
        path = course / "submitted" / name / CHAPTER / f"{CHAPTER}.ipynb"
        path.parent.mkdir(parents=True)
        path.write_text(handed_in(released, SUBMISSIONS / f"{name}.py"))
    (course / "marked.py").write_text(_MARK_AND_TELL_ONE)
    run("marked", CHAPTER, cwd=course)
    with Gradebook(f"sqlite:///{course / 'gradebook.db'}") as book:
        got = {s.student.id: (s.score, s.max_score) for s in book.assignment_submissions(CHAPTER)}
    assert got == {name: (points, MOST) for name, points in MARKS.items()}
    feedback = (course / "feedback" / "endless" / CHAPTER / f"{CHAPTER}.html").read_text()
    assert "signed_distance" in feedback


_MARK_AND_TELL_ONE = """
import sys
from nbgrader.apps import AutogradeApp, GenerateFeedbackApp

for app, options in ((AutogradeApp(), []), (GenerateFeedbackApp(), ["--student", "endless"])):
    app.initialize([sys.argv[1], *options])  # both in one process, which takes seconds to start
    app.start()
"""


def test_the_command_works_in_any_folder_and_beside_a_learners_notebooks(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "course").mkdir()
    work = tmp_path / "course" / "02_tsdf_fusion.ipynb"  # of make lab
    work.write_text("a learner's work")
    assert course(["export", "--out", "course", "2", "3"]) == 0
    assert work.read_text() == "a learner's work"
    source = tmp_path / "course" / "source"
    assert sorted(p.name[:2] for p in source.iterdir()) == ["02", "03"]
    with pytest.raises(ValueError, match="is there already"):
        course(["export", "--out", "course", "4", "2"])
    assert not [p for p in source.iterdir() if p.name.startswith("04")]


def test_an_answer_cell_holds_the_answer_only():
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = assignment_cells(json.loads(path.read_text())["cells"])
        for cell in cells:
            if cell["metadata"].get("nbgrader", {}).get("solution"):
                source = "".join(cell["source"])
                assert source.startswith("def "), (path.name, source)
        ids = [cell["id"] for cell in cells if "id" in cell]
        assert len(ids) == len(set(ids)), path.name


def test_every_chapter_can_be_exported():
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text())["cells"]
        checks = sum(
            "".join(c["source"]).strip().startswith("check.")
            for c in cells
            if c["cell_type"] == "code"
        )
        made = assignment_cells(cells)
        tests = [c for c in made if re.match(r"assert check\.", "".join(c["source"]))]
        answers = [
            c for c in made if "BEGIN SOLUTION" in "".join(c["source"]) and c["cell_type"] == "code"
        ]
        assert 3 <= len(tests) <= checks, path.name
        assert len(answers) >= len(tests), path.name
