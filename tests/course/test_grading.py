"""Marks for a class: what a submission needs, what it may do in the sandbox, who gets which
mark."""

import ast
import csv
import os
import re
from pathlib import Path

import pytest

from gsfusion_nb.course.attempt import Failed
from gsfusion_nb.course.exercise import exercises
from gsfusion_nb.course.grading.grade import grade
from gsfusion_nb.course.grading.judge import Limits, judge
from gsfusion_nb.course.grading.library import copy_library
from gsfusion_nb.course.grading.marks import Mark, as_csv, exercises_of
from gsfusion_nb.course.grading.submission import Cell, choose, find_submissions, needed, read_code

SUBMISSIONS = Path(__file__).parent / "submissions"

EXPECTED = {
    #                block_of, morton_code, running_average, signed_distance, zero_crossing
    "right": (1, 3, 2, 2, 2),
    "partly_right": (1, 0, 2, 2, 0),
    "wrong_sign": (0, 0, 0, 0, 0),
    "endless": (1, 0, 2, 0, 2),
    "out_of_memory": (1, 0, 0, 0, 2),
    "raises": (0, 0, 0, 0, 2),
}


@pytest.mark.ci  # test_nbgrader.py marks the same six with nbgrader, in make campaign
def test_six_submissions_get_the_marks_that_they_deserve():
    submissions = find_submissions([SUBMISSIONS])
    names = exercises_of((2,), (), submissions)
    marks = grade(submissions, names, limits=Limits(seconds=15.0))
    got = {name: tuple(int(m.points) for m in marks if m.student == name) for name in EXPECTED}
    assert got == EXPECTED
    said = {(m.student, m.exercise): f"{m.prop}; {m.message}" for m in marks}
    for student, exercise, words in (
        ("out_of_memory", "signed_distance", "allocate memory"),
        ("raises", "running_average", "ZeroDivisionError in line 11, `return 1 / 0`"),
        ("raises", "block_of", "line 3 of raises.py raised NameError"),
    ):
        assert words in said[student, exercise], (student, exercise)


def test_only_what_a_function_needs_runs():
    cells = [
        Cell("cell 1", "import torch\nSCALE = 2\nn = run_for_an_hour()\n%matplotlib inline\n!ls"),
        Cell("cell 2", "def half(x):\n    return x / SCALE\n\ndef f(x):\n    return 'the first'"),
        Cell(
            "cell 3",
            "def f(n):\n    y = [half(i) for i in n]\n    return torch.tensor(y)\nf = "
            "check.f.working(f)",
        ),
        Cell("cell 4", "SCALE = 4\nraise ValueError"),
        Cell("cell 5", "this is no Python: def g(x)"),
    ]
    lines = [(cell.label, node.lineno) for cell, node in needed(cells, "f")]
    assert lines == [
        ("cell 1", 1),
        ("cell 1", 2),
        ("cell 2", 1),
        ("cell 2", 4),
        ("cell 3", 1),
        ("cell 4", 1),
    ]
    named = Cell(
        "cell 6", 'def f(n):\n    """See check.f.hint() and check.f.working."""\n    return n'
    )
    assert [cell.label for cell, _ in needed([named], "f")] == ["cell 6"]
    with pytest.raises(Failed, match="cell 5"):
        needed(cells, "g")
    with pytest.raises(Failed, match="no function h"):
        needed(cells, "h")


def test_what_is_no_submission_is_said(tmp_path):
    (tmp_path / "broken.ipynb").write_text('{"cells": [')
    (tmp_path / "other.ipynb").write_text('{"worksheets": []}')
    (tmp_path / "latin.py").write_bytes(b"# \xe9")
    (tmp_path / "link.py").symlink_to(SUBMISSIONS / "right.py")  # what somebody else handed in
    (tmp_path / "deep.ipynb").write_text("[" * 100_000)
    (tmp_path / "long.py").write_text("def psnr(a, b): return 1\n" + "\n" * 4_000_000)
    assert all(read_code(file).problem for file in tmp_path.iterdir())
    with pytest.raises(ValueError, match="absent"):
        find_submissions([tmp_path / "absent"])


def test_what_is_no_file_gets_a_line_and_stops_nothing(tmp_path):
    folder = tmp_path / "class"
    (folder / "folder.py").mkdir(parents=True)
    os.mkfifo(folder / "endless.py")  # whose end never comes
    (folder / "link").symlink_to(SUBMISSIONS)
    (folder / "data").symlink_to(tmp_path / "empty")
    submissions = find_submissions([folder])
    assert [s.student for s in submissions] == ["endless", "folder", "link"]
    problems = [read_code(file).problem for s in submissions for file in s.files]
    for problem, words in zip(problems, ("a pipe", "a folder", "a link to"), strict=True):
        assert words in problem


def test_whose_a_file_is(tmp_path):
    for path in (
        "submitted/ann/ch2/02_tsdf_fusion.ipynb",
        "submitted/bob/ch2/02_tsdf_fusion.ipynb",
    ):
        (tmp_path / path).parent.mkdir(parents=True)
        (tmp_path / path).write_text("{}")
    assert [s.student for s in find_submissions([tmp_path / "submitted"])] == ["ann", "bob"]
    assert [s.student for s in find_submissions(sorted((tmp_path / "submitted").iterdir()))] == [
        "ann",
        "bob",
    ]
    assert [s.student for s in find_submissions([SUBMISSIONS / "right.py"])] == ["right"]


def test_no_cell_of_the_table_is_a_formula():
    names = ("=1+1", "+1", "-1", "@sum", "\t=1", " =1", "a\nb", 'he said "x", twice')
    marks = [
        Mark(
            student=n,
            exercise="psnr",
            points=1.5,
            most=2.0,
            message=n,
        )
        for n in names
    ]
    rows = list(csv.reader(as_csv(marks).splitlines()))
    assert len(rows) == 1 + len(names)
    assert all(
        not row[i].lstrip().startswith(("=", "+", "-", "@")) for row in rows[1:] for i in (0, 5)
    )
    assert rows[1][2:4] == ["1.5", "2"]


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The package without solutions."""
    return copy_library(tmp_path_factory.mktemp("grading") / "library")


@pytest.mark.ci
def test_a_function_that_ends_its_process_or_sleeps_leaves_the_next_one_alone(library):
    of = {
        "psnr": "import os\ndef psnr(image, reference): os._exit(3)",
        "block_of": "import time\nblock_of = time.sleep(100)\ndef block_of(xyz_W, voxel_size_m): "
        "return 1",
        "zero_crossing": "print('hello')\ndef zero_crossing(p0, p1, D0, D1): return p0 + (D0 / (D0 "
        "- D1))[:, None] * (p1 - p0)",
    }
    found = {
        name: judge(name, [Cell("cell 1", source)], Limits(seconds=4.0), library)
        for name, source in of.items()
    }
    assert "exit status 3" in found["psnr"].detail
    assert "4 s" in found["block_of"].detail
    assert found["zero_crossing"], found["zero_crossing"]


@pytest.mark.ci
def test_an_exercise_is_given_the_functions_that_its_notebook_gives_it():
    for path in (Path(__file__).parents[2] / "notebooks").glob("*.ipynb"):
        code = read_code(path)
        for exercise in exercises().values():
            if exercise.chapter == int(path.name[:2]):
                lines = [ast.unparse(node) for _, node in needed(code.cells, exercise.name)]
                given = re.findall(r"check\.(\w+)\.working", "\n".join(lines))
                assert set(given) == set(exercise.goes_on_with), exercise.name


SOLVED = {
    "map_frame": 6,
    "draw_keyframes": 6,
    "slope": 5,
    "quadtree_leaves": 3,
    "raster_rule": 9,
}
"""Exercise -> chapter: with a mapper, a generator, a function, and other exercises in what is
passed."""


@pytest.mark.ci
def test_solved_chapters_pass_in_the_sandbox(library):
    codes = [
        read_code(path)
        for path in sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))
    ]
    for name, chapter in SOLVED.items():
        code = choose(codes, name, chapter)
        assert code is not None
        verdict = judge(name, code.cells, Limits(), library)
        assert verdict, repr(verdict)
