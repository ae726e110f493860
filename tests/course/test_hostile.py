"""Submissions that want marks without solving, or that stop the grading of a class."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gsfusion_nb.course.exercise import exercises
from gsfusion_nb.course.grading import sandbox
from gsfusion_nb.course.grading.grade import grade
from gsfusion_nb.course.grading.judge import Limits, judge
from gsfusion_nb.course.grading.library import copy_library, library_for
from gsfusion_nb.course.grading.submission import Cell, find_submissions

HERE = Path(__file__).parent
HONEST = HERE / "submissions"
RIGHT = {"right", "endless", "out_of_memory", "raises", "child_holds_output", "thread_stays"}
"""Whose zero_crossing is right, whatever else they do."""
SAID = {
    "endless_bare_except": "more than 10 s",
    "endless_signals": "more than 10 s",
    "endless_import": "more than 10 s",
    "stopped": "more than 10 s",
    "long_message": "characters)",
    "equal_hashes": "more than 20,000 entries",
    "link": "is a link",
    "killed_parent": "SIGKILL",
    "changed_inputs": "has changed",
    "library_function": "computes what the exercise asks for",
}
LIMITS = Limits(seconds=10.0, memory_mb=1500)
needs_bubblewrap = pytest.mark.skipif(
    bool(sandbox.why_no_bubblewrap()), reason=sandbox.why_no_bubblewrap() or "-"
)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The package without solutions."""
    return copy_library(tmp_path_factory.mktemp("hostile") / "library")


@pytest.fixture(params=["bubblewrap", "without"])
def wall(request, monkeypatch):
    """With bubblewrap, and without it."""
    if request.param == "without":
        monkeypatch.setattr(sandbox, "bubblewrap", lambda: "")
    elif sandbox.why_no_bubblewrap():
        pytest.skip(sandbox.why_no_bubblewrap())
    return request.param


def hostile(name: str) -> list[Cell]:
    return [Cell(f"{name}.py", (HERE / "hostile" / f"{name}.py").read_text())]


def class_of(folder: Path) -> Path:
    folder.mkdir()
    for path in [*HONEST.glob("*.py"), *(HERE / "hostile").glob("*.py")]:
        shutil.copy(path, folder)
    (folder / "link.py").symlink_to("right.py")
    return folder


@pytest.mark.ci  # some 40 processes, six of which are waited for
@needs_bubblewrap
def test_a_class_gets_the_marks_that_it_deserves(tmp_path):
    submissions = find_submissions([class_of(tmp_path / "class")])
    assert len(submissions) >= 30
    marks = {m.student: m for m in grade(submissions, ["zero_crossing"], limits=LIMITS)}
    assert {name for name, mark in marks.items() if mark.points} == RIGHT
    for name, words in SAID.items():
        assert words in marks[name].message, marks[name]
    assert max(len(m.message) for m in marks.values()) < 5000


def test_a_loop_that_no_exception_leaves_is_ended(library, wall):
    verdict = judge("zero_crossing", hostile("endless_bare_except"), Limits(seconds=1.0), library)
    assert "more than 1 s" in verdict.detail


@pytest.mark.parametrize("name", ["patched_checker", "forged_verdict"])
def test_a_patched_checker_and_a_forged_verdict_give_nothing(library, name):
    assert not judge("zero_crossing", hostile(name), LIMITS, library)


HIDDEN = "import sys\n{imported}\ndef {name}(*args):\n    sys.setprofile(None)\n    return {call}"


@pytest.mark.parametrize(
    ("name", "imported", "call"),
    [
        ("psnr", "from gsfusion_nb import evaluation", "evaluation.psnr(*args)"),
        ("invert_pose", "from gsfusion_nb.geometry import se3", "se3.inverse(*args)"),
    ],
)
def test_a_hidden_call_of_the_library_is_no_answer(library, name, imported, call):
    cells = [Cell("cell 1", HIDDEN.format(name=name, imported=imported, call=call))]
    verdict = judge(name, cells, LIMITS, library)
    assert "computes what the exercise asks for" in verdict.detail


@pytest.mark.ci
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux only")
@pytest.mark.parametrize("kind", ["shared maps", "children"])
def test_memory_is_limited(library, kind):
    cells = {
        "shared maps": "import mmap\ndef psnr(a, b):\n    m = mmap.mmap(-1, 2_000_000_000)\n"
        "    return 1.0",
        "children": "import os, time\ndef psnr(a, b):\n    for _ in range(6):\n"
        "        if os.fork() == 0:\n            kept = b'x' * 300_000_000\n"
        "            time.sleep(60)\n    time.sleep(60)",
    }
    limits = Limits(seconds=30.0, memory_mb=1000)
    verdict = judge("psnr", [Cell("cell 1", cells[kind])], limits, library)
    assert verdict.state == "failed"
    assert "mmap" in verdict.detail or "more than 1,000 MB" in verdict.detail


@pytest.mark.ci
def test_a_child_that_stays_does_not_stall_and_is_ended(tmp_path, library, wall):
    # without bubblewrap it is the judge's own process that takes over what a submission leaves
    program = (
        "import sys\nfrom pathlib import Path\n"
        "from gsfusion_nb.course.grading import process, sandbox\n"
        "from gsfusion_nb.course.grading.judge import *\n"
        "process.become_reaper()\n"
        f"if {wall == 'without'}: sandbox.bubblewrap = lambda: ''\n"
        f"cells = [Cell('c', open({str(HERE / 'hostile' / 'child_holds_output.py')!r}).read())]\n"
        f"library = Path({str(library)!r})\n"
        "print(judge('zero_crossing', cells, Limits(seconds=20.0), library).state)\n"
        "print(process._children(process.os.getpid()))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        timeout=120,
        env=os.environ | {"TMPDIR": str(tmp_path)},
    )
    assert done.stdout.split() == ["passed", "[]"], done.stderr[-2000:]


def test_no_solution_is_in_the_copy_of_the_package(library):
    text = "".join(path.read_text() for path in library.rglob("*.py"))
    for exercise in exercises().values():
        words = [w.says for w in exercise.wrong]
        assert f"def {exercise._solution.__name__}(" not in text or words[0] not in text
    names = {path.name for path in library.rglob("*")}
    assert not names & {"notebooks", "docs", "judge.py", "marks.py", "exam_solution.md"}


@pytest.mark.parametrize(
    "name", ["morton_code", "psnr", "project_points", "lift_pixels", "invert_pose"]
)
def test_the_function_that_an_exercise_becomes_is_not_in_its_copy(library, name):
    exercise = exercises()[name]
    copy = library_for(exercise, library)
    assert len(exercise.replaces) == (2 if name == "morton_code" else 1)
    for function in exercise.replaces:
        name = f"{function.__module__.replace('.', '/')}.py"
        whole = (library / name).read_text()
        text = (copy / name).read_text()
        for each in (whole, text):
            assert f"def {function.__name__}(" in each
        removed = "this function of the library computes what the exercise asks for"
        assert removed not in whole
        assert text.count(removed) == len(exercise.replaces)
