"""The notebooks: stored as they ran, light, and they run again in an empty folder without
network."""

import ast
import contextlib
import functools
import json
import os
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from quick_run import quick

from gsfusion_nb.course.copies import without_solutions
from gsfusion_nb.course.short_path import short_path

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
EACH = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)

MAX_BYTES = 1_000_000
MAX_HTML_BYTES = 200_000
SMOKE_LIMIT_S = 180
"""Twenty seconds on a quiet machine with compiled kernels; the rest is for compiling and for a busy
machine."""

_MACHINE_PATH = re.compile(
    r"(?:/home/|/root/|/Users/|/tmp/|/work/|/private/|site-packages|[A-Z]:\\\\?Users)"
)

_CHECK = re.compile(r"^check\.(?P<name>\w+)\((?P=name)\)$", re.MULTILINE)
"""The line that judges a student's function; other functions are judged to show what a verdict
looks like."""

# A child process whose sockets reach this machine only: the notebook's kernel inherits it through
# sitecustomize.
_NO_NETWORK = """
import socket
_connect = socket.socket.connect
_THIS_MACHINE = ("127.0.0.1", "::1", "localhost")
def connect(self, address):
    of_the_internet = self.family in (socket.AF_INET, socket.AF_INET6)
    if of_the_internet and address[0] not in _THIS_MACHINE:
        raise OSError(f"this test allows no network, but something connects to {address}")
    return _connect(self, address)
socket.socket.connect = connect
"""

# What only tests and other extras install, the notebook cannot import.
_NO_EXTRAS = """
from importlib.machinery import PathFinder
_find_spec = PathFinder.find_spec
def find_spec(name, path=None, target=None):
    return None if name.partition(".")[0] in {absent} else _find_spec(name, path, target)
PathFinder.find_spec = find_spec
"""

_EXECUTE = """
import sys, warnings
import nbformat
from nbclient import NotebookClient
warnings.simplefilter("ignore")
notebook = nbformat.read(sys.argv[1], as_version=4)
try:
    NotebookClient(notebook, timeout=int(sys.argv[2]), kernel_name="python3").execute()
finally:
    nbformat.write(notebook, sys.argv[1])
"""


def cells(path: Path) -> list[dict]:
    return json.loads(path.read_text(encoding="utf-8"))["cells"]


def outputs(path: Path) -> list[dict]:
    return [
        output for cell in cells(path) if cell["cell_type"] == "code" for output in cell["outputs"]
    ]


def answers(path: Path) -> list[bool]:
    """Whether each code cell shows something. How many pieces its text has depends on when the
    kernel flushed it."""
    return [bool(cell["outputs"]) for cell in cells(path) if cell["cell_type"] == "code"]


def joined(text: str | list[str]) -> str:
    return text if isinstance(text, str) else "".join(text)


def test_there_are_notebooks():
    assert [p.name for p in NOTEBOOKS][:1] == ["00_quickstart.ipynb"]


@EACH
def test_stored_executed_from_top_to_bottom_without_errors(path):
    """``make chapters CHAPTERS="09 12"`` makes it so."""
    code = [
        cell
        for cell in cells(path)
        if cell["cell_type"] == "code" and joined(cell["source"]).strip()
    ]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert [output["ename"] for output in outputs(path) if output["output_type"] == "error"] == []
    assert [joined(o["text"]) for o in outputs(path) if o.get("name") == "stderr"] == []


@EACH
def test_stored_outputs_are_light_and_tell_nothing_about_a_machine(path):
    assert path.stat().st_size <= MAX_BYTES
    document = json.loads(path.read_text(encoding="utf-8"))
    assert "widgets" not in document["metadata"], (
        "widget state is stored; execute with GSNB_VIEW=static"
    )
    pictures = 0
    for output in outputs(path):
        data = {
            mime: joined(text)
            for mime, text in output.get("data", {}).items()
            if isinstance(text, (str, list))
        }
        assert len(data.get("text/html", "")) <= MAX_HTML_BYTES
        assert "application/vnd.jupyter.widget-view+json" not in output.get("data", {})
        pictures += any(mime.startswith("image/") for mime in data)
        words = [
            data.get("text/plain", ""),
            data.get("text/html", ""),
            joined(output.get("text", "")),
        ]
        found = _MACHINE_PATH.search("\n".join(words))
        assert found is None, f"an output names a folder of somebody's machine: {found}"
    assert pictures >= 3


@EACH
def test_has_the_parts_of_a_chapter(path):
    text = "\n".join(
        joined(cell["source"]) for cell in cells(path) if cell["cell_type"] == "markdown"
    )
    for part in ("Goal", "What breaks if", "Exercise", "Further reading"):
        assert part in text, f"{path.name} has no {part!r}"
    assert "**Predict" not in text, "a prediction is a cell with predict(...), which can be clicked"
    assert any(re.search(r"^(course\.)?predict\(", joined(c["source"])) for c in cells(path)), (
        "no prediction"
    )
    tagged = [cell for cell in cells(path) if "parameters" in cell["metadata"].get("tags", [])]
    assert len(tagged) == 1
    assert quick({"cells": tagged})["cells"][0]["source"] != tagged[0]["source"], (
        "the quick version is as long"
    )
    assert "SMOKE" not in "".join(joined(cell["source"]) for cell in cells(path))


@EACH
def test_every_exercise_is_solved_and_its_solution_can_be_stripped(path):
    """A stored notebook is the teacher's: ``check.name(name)`` is green; the student's cell comes
    before a solution."""
    code = [cell for cell in cells(path) if cell["cell_type"] == "code"]
    checked = [(_CHECK.search(joined(cell["source"])), cell) for cell in code]
    checked = {found["name"]: cell for found, cell in checked if found}
    if path.stem >= "01":
        assert len(checked) >= 3, f"{path.name} has fewer than three exercises"
    for name, cell in checked.items():
        shown = [
            joined(output["data"]["text/plain"]) for output in cell["outputs"] if "data" in output
        ]
        assert any(text.startswith(f"✓ {name}") for text in shown), (
            f"check.{name} is not green: {shown}"
        )
        sources = [joined(c["source"]) for c in code]
        written = [s for s in sources if f"def {name}(" in s]
        assert ["BEGIN SOLUTION" in s for s in written] == [False, True]
        assert ast.unparse(ast.parse(written[0])).rstrip().endswith("...")
        assert has_difficulty(path, name), (
            f"{path.name} does not tell difficulty and time of {name}"
        )


def has_difficulty(path: Path, name: str) -> bool:
    """Whether the text before the student's cell has stars and minutes."""
    before = ""
    for cell in cells(path):
        source = joined(cell["source"])
        if cell["cell_type"] == "code" and f"def {name}(" in source:
            return "★" in before and "minutes" in before
        before = source if cell["cell_type"] == "markdown" else before
    return False


@EACH
def test_code_cells_parse_and_are_short(path):
    for cell in cells(path):
        if cell["cell_type"] == "code":
            source = joined(cell["source"])
            ast.parse(source)
            assert len(source.splitlines()) <= 30, (
                f"a long cell in {path.name}: {source.splitlines()[0]}"
            )


@functools.cache
def not_from_setup() -> list[str]:
    """Modules that are installed here but not by ``make setup``."""
    wanted: set[str] = {"pip", "setuptools"}
    todo: list[tuple[str, tuple[str, ...]]] = [("gsfusion-nb", ())]
    while todo:
        name, extras = todo.pop()
        wanted.add(canonicalize_name(name))
        with contextlib.suppress(metadata.PackageNotFoundError):
            for needed in map(Requirement, metadata.distribution(name).requires or ()):
                used = any(
                    not needed.marker or needed.marker.evaluate({"extra": e}) for e in ("", *extras)
                )
                if used and (canonicalize_name(needed.name) not in wanted or needed.extras):
                    todo.append((needed.name, tuple(needed.extras)))
    of_modules = metadata.packages_distributions().items()
    return sorted(
        m for m, packages in of_modules if not wanted.intersection(map(canonicalize_name, packages))
    )


def run_quickly(notebook: dict, name: str, tmp_path: Path) -> Path:
    """Execute in an empty folder without network, in smoke mode; the executed copy."""
    folder = tmp_path / "empty"
    site = tmp_path / "site"
    folder.mkdir()
    site.mkdir()
    kept_out = _NO_EXTRAS.format(absent=not_from_setup())
    (site / "sitecustomize.py").write_text(_NO_NETWORK + kept_out, encoding="utf-8")
    copy = folder / name
    copy.write_text(json.dumps(quick(notebook)), encoding="utf-8")
    environment = os.environ | {
        "GSNB_SMOKE": "1",
        "PYTHONPATH": str(site),
        "IPYTHONDIR": str(tmp_path / "ipython"),
    }
    done = subprocess.run(
        [sys.executable, "-c", _EXECUTE, str(copy), str(SMOKE_LIMIT_S)],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=2 * SMOKE_LIMIT_S,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    assert [output for output in outputs(copy) if output["output_type"] == "error"] == []
    return copy


@EACH
@pytest.mark.ci
def test_runs_in_an_empty_folder_without_network(path, tmp_path):
    cleared = json.loads(path.read_text(encoding="utf-8"))
    for cell in cleared["cells"]:
        if cell["cell_type"] == "code":
            cell |= {"outputs": [], "execution_count": None}
    copy = run_quickly(cleared, path.name, tmp_path)
    cells_in_turn = enumerate(zip(answers(copy), answers(path), strict=True))
    silent = [number for number, (quick, stored) in cells_in_turn if stored and not quick]
    assert silent == [], (
        "cells that show something in the stored notebook and nothing in the quick run"
    )


@EACH
@pytest.mark.slow
def test_the_student_copy_runs_with_nothing_solved(path, tmp_path):
    """The library's answers stand in for those that are missing."""
    student = without_solutions(json.loads(path.read_text(encoding="utf-8")))
    exercises = [
        _CHECK.search(joined(cell["source"]))
        for cell in student["cells"]
        if cell["cell_type"] == "code"
    ]
    if not any(exercises):
        pytest.skip(f"{path.name} has no checked exercise")
    copy = run_quickly(student, path.name, tmp_path)
    verdicts = [
        joined(o["data"]["text/plain"])
        for o in outputs(copy)
        if "gsnb-verdict" in str(o.get("data"))
    ]
    assert sum("not written" in verdict for verdict in verdicts) == sum(map(bool, exercises))
    assert not any(verdict.startswith("✓") for verdict in verdicts)


@pytest.mark.slow  # in a browser it is walked with typed solutions
@pytest.mark.parametrize(("edition", "solved"), [(without_solutions, False), (dict, True)])
def test_the_short_path_runs(edition, solved, tmp_path):
    copy = run_quickly(edition(short_path(FOLDER)), "short_path.ipynb", tmp_path)
    verdicts = [
        joined(o["data"]["text/plain"])
        for o in outputs(copy)
        if "gsnb-verdict" in str(o.get("data"))
    ]
    assert len(verdicts) == 5
    assert all(
        verdict.startswith("✓") if solved else "not written" in verdict for verdict in verdicts
    )
