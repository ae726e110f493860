"""Marks for a class: what a submission needs, what it may do in the sandbox, who gets which mark."""

import csv
import os
from pathlib import Path

import pytest
import torch

from gsfusion_nb.course.attempt import Attempt, Failed, NotCallable
from gsfusion_nb.course.exercise import exercises
from gsfusion_nb.course.grading import sandbox as module
from gsfusion_nb.course.grading.draws import DRAWS
from gsfusion_nb.course.grading.marking import (
    _OWN,
    HIDDEN,
    judge_hidden,
    properties,
    sentence,
    verdict_on,
    verdicts,
    why,
)
from gsfusion_nb.course.grading.marks import (
    Grading,
    Mark,
    Points,
    as_csv,
    exercises_of,
    grade,
    read_points,
    rubric_page,
)
from gsfusion_nb.course.grading.sandbox import Limits, Sandbox, unprotected, why_no_bubblewrap
from gsfusion_nb.course.grading.sandbox_program import Cell, needed
from gsfusion_nb.course.grading.submission import choose, find_submissions, read_code

SUBMISSIONS = Path(__file__).parent / "submissions"
LIMITS = Limits(seconds=5.0, memory_mb=512)

EXPECTED = {
    #                block_of, morton_code, running_average, signed_distance, zero_crossing
    "right": (1, 3, 2, 2, 2),
    "partly_right": (1, 0, 2, 2, 0),
    "wrong_sign": (0, 0, 0, 0, 0),
    "wrong_table": (0, 0, 0, 0, 0),
    "endless": (1, 0, 2, 0, 2),
    "out_of_memory": (1, 0, 0, 0, 2),
    "raises": (0, 0, 0, 0, 2),
}


@pytest.mark.ci
def test_seven_submissions_get_the_marks_that_they_deserve():
    submissions = find_submissions([SUBMISSIONS])
    names = exercises_of((2,), (), submissions)
    limits = Limits(seconds=2.0, memory_mb=512)
    marks = grade(submissions, Grading(names=names, points=Points(), limits=limits, seed=3))
    got = {name: tuple(int(m.points) for m in marks if m.student == name) for name in EXPECTED}
    assert got == EXPECTED
    said = {(m.student, m.exercise): f"{m.prop}; {m.message}" for m in marks}
    for student, exercise, words in (
        ("endless", "signed_distance", "had not ended after"),
        ("out_of_memory", "signed_distance", "needed more memory"),
        ("wrong_table", "zero_crossing", HIDDEN),
        ("raises", "running_average", "ZeroDivisionError in line 11 of raises.py, `return 1 / 0`"),
        ("raises", "block_of", "line 3 of raises.py"),
    ):
        assert words in said[student, exercise], (student, exercise)


def test_a_message_names_an_input_only_if_the_function_got_one():
    def undefined(*args):
        raise NotCallable("it is defined", "", "02.py has a syntax error in line 6")

    verdict = verdict_on(exercises()["block_of"], undefined, seed=1)
    assert why(verdict) == ("it is defined", "02.py has a syntax error in line 6")
    verdict = verdict_on(exercises()["block_of"], lambda xyz_W, voxel_size_m: torch.zeros(1, 3), seed=1)
    assert sentence(verdict) == (
        "not true yet: “above zero, block k reaches from 8 k to 8 (k + 1) voxels”; "
        "input: (0.30, 0.05, 0.85) m with voxels of 5 cm; got 0 at [0, 2], expected 2"
    )


def test_every_exercise_has_hidden_inputs_on_which_its_solution_passes():
    known = exercises()
    assert set(DRAWS) | set(_OWN) == set(known)
    slow = {"raster_rule", "silhouette_rule", "map_frame", "budget_cells"}
    for name in set(known) - slow:
        judge_hidden(known[name], Attempt(known[name]._solution), seed=1)


def test_hidden_inputs_depend_on_the_seed_alone():
    seen = []
    for seed in (1, 1, 2):
        asked = []

        def solved(xyz_W, voxel_size_m, asked=asked):
            asked.append(xyz_W)
            return exercises()["block_of"]._solution(xyz_W, voxel_size_m)

        judge_hidden(exercises()["block_of"], Attempt(solved), seed)
        seen.append(torch.stack(asked))
    assert torch.equal(seen[0], seen[1])
    assert not torch.equal(seen[0], seen[2])


def test_only_what_a_function_needs_runs():
    cells = [
        Cell("cell 1", "import torch\nSCALE = 2\nn = run_for_an_hour()\n%matplotlib inline\n!ls"),
        Cell("cell 2", "def half(x):\n    return x / SCALE\n\ndef f(x):\n    return 'the first'"),
        Cell("cell 3", "def f(n):\n    y = [half(i) for i in n]\n    return torch.tensor(y)"),
        Cell("cell 4", "SCALE = 4\nraise ValueError"),
        Cell("cell 5", "this is no Python: def g(x)"),
    ]
    lines = [(s.cell.label, s.node.lineno) for s in needed(cells, "f")]
    assert lines == [("cell 1", 1), ("cell 2", 1), ("cell 3", 1), ("cell 4", 1)]
    with pytest.raises(Failed, match="cell 5 has a syntax error in line 1"):
        needed(cells, "g")
    with pytest.raises(Failed, match="no function h"):
        needed(cells, "h")


def test_what_is_no_submission_is_said(tmp_path):
    (tmp_path / "julia.ipynb").write_text('{"cells": [], "metadata": {"kernelspec": {"language": "julia"}}}')
    (tmp_path / "broken.ipynb").write_text('{"cells": [')
    (tmp_path / "other.ipynb").write_text('{"worksheets": []}')
    (tmp_path / "latin.py").write_bytes(b"# \xe9")
    (tmp_path / "link.py").symlink_to(SUBMISSIONS / "right.py")
    problems = {file.name: read_code(file).problem for file in tmp_path.iterdir()}
    for name, words in (
        ("julia.ipynb", "kernel is for julia"), ("broken.ipynb", "cannot be read"), ("other.ipynb", "no list of cells"),
        ("latin.py", "not text in UTF-8"), ("link.py", "is a link"),
    ):  # fmt: skip
        assert words in problems[name]
    with pytest.raises(ValueError, match="there is nothing at"):
        find_submissions([tmp_path / "absent"])


def test_whose_a_file_is(tmp_path):
    for path in ("submitted/ann/ch2/02_tsdf_fusion.ipynb", "submitted/bob/ch2/02_tsdf_fusion.ipynb"):
        (tmp_path / path).parent.mkdir(parents=True)
        (tmp_path / path).write_text("{}")
    assert [s.student for s in find_submissions([tmp_path])] == ["ann", "bob"]
    assert [s.student for s in find_submissions([tmp_path / "submitted"])] == ["ann", "bob"]
    assert [s.student for s in find_submissions([SUBMISSIONS / "right.py"])] == ["right"]
    chapters = sorted((tmp_path / "submitted").glob("*/ch2"))
    for folder, name in zip(chapters, ("cleo", "dan"), strict=True):
        folder.rename(tmp_path / name)
    assert [s.student for s in find_submissions([tmp_path / "cleo", tmp_path / "dan"])] == ["cleo", "dan"]


def test_the_files_of_two_students_are_not_taken_for_those_of_one(tmp_path):
    for name in ("ann", "bob"):
        (tmp_path / name / "ch2").mkdir(parents=True)
        (tmp_path / name / "ch2" / "answers.py").write_text("")
    with pytest.raises(ValueError, match=r"ch2/answers.py is in .*ann and in .*bob: name the folder"):
        find_submissions([tmp_path / "ann", tmp_path / "bob"])


def test_no_cell_of_the_table_is_a_formula():
    names = ("=1+1", "+1", "-1", "@sum", "\t=1", " =1", "a\nb", 'he said "x", twice')
    marks = [Mark(student=n, exercise="psnr", points=1.5, most=2.0, message=n) for n in names]
    rows = list(csv.reader(as_csv(marks).splitlines()))
    assert rows[0] == ["student", "exercise", "points", "max", "failed property", "message"]
    assert len(rows) == 1 + len(names)
    assert all(not row[i].lstrip().startswith(("=", "+", "-", "@")) for row in rows[1:] for i in (0, 5))
    assert rows[1][2:4] == ["1.5", "2"]


def test_points_from_a_table(tmp_path):
    table = tmp_path / "points.toml"
    table.write_text("[difficulty]\n1 = 4\n[exercise]\npsnr = 2.5\n")
    points = read_points(table)
    assert [points.of(exercises()[name]) for name in ("exam_frames", "psnr", "adam")] == [4, 2.5, 3]
    for text, words in (
        ("[exercise]\npsrn = 1", "no exercise 'psrn'"),
        ("[difficulty]\n1 = -1", "from 0 on"),
        ("x", "points"),
    ):
        table.write_text(text)
        with pytest.raises(ValueError, match=words):
            read_points(table)


def test_the_rubric_names_points_and_properties():
    page = rubric_page(("psnr", "block_of"), Points())
    assert "one mean over the whole picture" in page
    assert "3 points in all" in page
    assert properties(exercises()["block_of"])[-1] == HIDDEN


def called(source, *args, limits=LIMITS):
    """What the function ``f`` of a submission returns in a sandbox."""
    with Sandbox(limits) as sandbox:
        return sandbox.function("f", [Cell("cell 1", source)])(*args)


def test_numba_works_where_submissions_run():
    source = """
import numba, numpy as np, torch
@numba.njit
def total(x):
    return x.sum()
def f(x):
    return total(x.numpy())
"""
    assert called(source, torch.arange(4.0)) == 6.0


def test_each_function_is_limited():
    source = """
import resource
def f():
    return [resource.getrlimit(getattr(resource, "RLIMIT_" + kind))[0] for kind in ("CPU", "AS", "NPROC", "FSIZE")]
"""
    cpu_s, memory, tasks, file = called(source)
    assert 5 < cpu_s < 300
    assert 512 << 20 < memory < 64 << 30
    assert tasks <= 4096
    assert file == 64 << 20


SOLVED = {"map_frame": 6, "draw_keyframes": 6, "slope": 5, "quadtree_leaves": 3}
"""Exercise -> chapter: with a mapper, a generator, a function, and other exercises in what is passed."""


@pytest.mark.ci
def test_whatever_is_passed_to_a_function_reaches_it_in_the_sandbox():
    codes = [read_code(path) for path in sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))]
    chosen = {name: choose(codes, name, chapter) for name, chapter in SOLVED.items()}
    for verdict in verdicts({name: code.cells for name, code in chosen.items() if code}, 5, LIMITS).values():
        assert verdict, repr(verdict)


def test_a_result_that_is_no_value_is_refused_without_being_made_here():
    source = "import os\nclass Evil:\n    def __reduce__(self): return os._exit, (1,)\ndef f(): return Evil()"
    with pytest.raises(Failed, match="plain values"):
        called(source)
    with pytest.raises(Failed, match="does not change its inputs"):
        called("def f(x):\n    return x.zero_()", torch.ones(2))


@pytest.mark.skipif(bool(why_no_bubblewrap()), reason=why_no_bubblewrap())
def test_behind_bubblewrap_nothing_of_the_grader_can_be_seen_or_changed(tmp_path):
    source = """
import os, socket
def f(paths):
    seen = [path for path in paths if os.path.exists(path)]
    try:
        open(os.path.join(os.path.dirname(os.__file__), "mark.txt"), "w")
        seen.append("written")
    except OSError:
        pass
    return seen, len(socket.if_nameindex())
"""
    real = module._package_folder()
    hidden = [real / "course" / "tsdf.py", real.parent / "notebooks", tmp_path, Path.home() / ".bashrc"]
    assert called(source, [*map(str, hidden), os.__file__]) == ([os.__file__], 1)


def test_without_bubblewrap_grading_goes_on_and_says_what_is_open(monkeypatch):
    module.why_no_bubblewrap.cache_clear()
    monkeypatch.setattr(module.shutil, "which", lambda name: None)
    try:
        assert "bubblewrap (bwrap) is not installed" in unprotected()
        assert called("def f(x):\n    return x + 1", 1) == 2
        with pytest.raises(Failed, match="processor time"):
            called("def f():\n    while True: pass", limits=Limits(seconds=1.0, memory_mb=512))
    finally:
        module.why_no_bubblewrap.cache_clear()


def test_a_function_that_ends_its_process_leaves_the_next_one_alone():
    with Sandbox(LIMITS) as sandbox:
        with pytest.raises(Failed):
            sandbox.function("f", [Cell("cell 1", "import os\ndef f(): os._exit(0)")])()
        assert sandbox.function("f", [Cell("cell 1", "def f(): return 5")])() == 5
