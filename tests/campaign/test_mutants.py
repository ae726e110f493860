"""What the campaign of mutants changes, which tests it chooses, and what its table says; by hand on
small sources."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip(
    "cosmic_ray", reason="make campaign installs it: pip install cosmic-ray coverage"
)

sys.path.append(str(Path(__file__).parent))
import mutant_sites
import mutant_tests
import mutants

SOURCE = '''"""Doc."""
LIMIT = 3


@dataclass(frozen=True)
class A:
    x: int | None = 2


def f(a, *, b=1):
    c = g(*a, b *
          2)
    c[0] = 5
    if c > LIMIT:
        raise ValueError(f"{a - 1}")
    return zip(a, b, strict=True)
'''


def changes(source: str) -> dict[str, set[str]]:
    """Line of a source -> what the mutants have in its place."""
    found: dict[str, set[str]] = {}
    for site, kinds in mutant_sites.sites(source).items():
        for kind in kinds:
            mutant = mutant_sites.described("f.py", source, site, *kind)
            found.setdefault(mutant.original, set()).add(mutant.changed)
    return found


def test_every_mutant_of_a_source():
    assert changes(SOURCE) == {
        "LIMIT = 3": {"LIMIT = 4", "LIMIT = 2"},
        "x: int | None = 2": {"x: int | None = 3", "x: int | None = 1"},
        "def f(a, *, b=1):": {"def f(a, *, b= 2):", "def f(a, *, b= 0):"},
        "c = g(*a, b *": {"c = g(*a, b /"},
        "c = g(*a, b * 2)": {"c = g(*a, b * 3)", "c = g(*a, b * 1)"},  # Cosmic Ray joins the lines
        "c[0] = 5": {"pass", "c[ 1] = 5", "c[ -1] = 5", "c[0] = 6", "c[0] = 4"},
        "if c > LIMIT:": {"if c >= LIMIT:", "if c <= LIMIT:", "if not c > LIMIT:"},
    }


def test_files_without_mutants_exist():
    assert [file for file in mutant_sites.CONTENT if not (mutants.ROOT / file).is_file()] == []


@pytest.mark.parametrize(
    ("line", "lines"),
    [
        (2, [11, 12, 13, 14, 15, 16]),  # a constant: all that any function does
        (10, [11, 12, 13, 14, 15, 16]),  # a default: what its function does
        (12, [11, 12]),
        (14, [14]),
    ],
)
def test_lines_with_which_a_change_has_an_effect(line, lines):
    assert mutant_sites.executed_lines(ast.parse(SOURCE), line) == lines


def mutant(**changed):
    values = {
        "file": "gsfusion_nb/render/a.py",
        "operator": "NumberReplacer",
        "occurrence": 0,
        "line": 2,
    }
    return mutant_sites.Mutant(
        **values | {"runs_with": (2,), "original": "return 1", "changed": "return 2"} | changed
    )


def test_the_room_s_own_tests_come_first_then_others_that_know_the_module():
    seconds = {
        "tests/map/test_m.py::a": 1.0,
        "tests/render/test_a.py::slow": 9.0,
        "tests/render/test_a.py::quick": 1.0,
    }
    seconds |= {"tests/render/test_a.py::other": 1.0, "tests/render/test_b.py::far": 1.0}
    m, slow, quick, other, far = seconds
    lines = {"gsfusion_nb/render/a.py": {2: [m, slow, quick], 9: [other, far]}}
    coverage = mutant_tests.Coverage(seconds=seconds, lines=lines)
    assert coverage.of(mutant(), 100.0) == [quick, slow, m, other, far]
    assert coverage.of(mutant(), 4.0) == [quick, m, other, far]
    # an import may execute it
    assert set(coverage.of(mutant(runs_with=(3,)), 100.0)) == set(seconds)
    assert coverage.of(mutant(file="gsfusion_nb/render/unknown.py"), 100.0) == []
    assert set(
        coverage.of(mutant(runs_with=(), file="gsfusion_nb/render/constants.py"), 100.0)
    ) == set(seconds)


MEASURED = """
import subprocess, sys
import pytest
from gsfusion_nb import m

@pytest.fixture(scope="module")
def made():
    return m.shared()

def test_first(made):
    assert made == 1

def test_second(made):
    assert m.own() == 2

def test_in_a_process():
    subprocess.run([sys.executable, "-c", "from gsfusion_nb import m; m.there()"], check=True)

def test_that_fails():
    assert m.own() == 3
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_line_belongs_to_the_tests_that_need_it(tmp_path):
    """What a shared fixture executes is needed by all tests that use it, and a process belongs to
    its test."""
    tree = tmp_path / "tree"
    for folder in ("tests/x", "gsfusion_nb"):
        (tree / folder).mkdir(parents=True)
    (tree / "gsfusion_nb/__init__.py").touch()
    (tree / "gsfusion_nb/m.py").write_text(
        "".join(f"def {f}():\n    return {i}\n" for f, i in FUNCTIONS.items())
    )
    (tree / "tests/x/test_m.py").write_text(MEASURED)
    measure = "import mutant_tests, pathlib; mutant_tests.covered({}, ['tests/x'], {}, {})"
    paths = [f"pathlib.Path({str(p)!r})" for p in (tree, tmp_path / "scratch", tmp_path / "m.json")]
    subprocess.run(
        [sys.executable, "-c", measure.format(*paths)],
        cwd=Path(__file__).parent,
        check=True,
    )
    lines = mutant_tests.read_coverage([tmp_path / "m.json"]).lines["gsfusion_nb/m.py"]
    found = {name: {t.split("::")[1] for t in lines[2 * i + 2]} for i, name in enumerate(FUNCTIONS)}
    assert found == {
        "shared": {"test_first", "test_second"},
        "own": {"test_second"},
        "there": {"test_in_a_process"},
    }


FUNCTIONS = {"shared": 1, "own": 2, "there": 3}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize(
    ("test", "what"),
    [("assert f() == 1", "killed"), ("assert f() > 0", "survived"), ("import m", "survived")],
)
def test_a_mutant_is_killed_by_a_test_that_fails(tmp_path, test, what):
    tree = tmp_path / "tree"
    (tree / "tests").mkdir(parents=True)
    (tree / "m.py").write_text("def f():\n    return 1\n")
    (tree / "tests/test_m.py").write_text(f"from m import f\n\ndef test_f():\n    {test}\n")
    verdict = mutant_tests.verdict(
        tree, mutant(file="m.py"), ["tests/test_m.py::test_f"], 1.0, tmp_path / "scratch"
    )
    assert verdict == what, (tmp_path / "scratch/out.txt").read_text()
    assert Path(tree / "m.py").read_text() == "def f():\n    return 1\n"


def test_the_table_counts_a_listed_survivor_as_what_it_is():
    by_file = {
        "killed": "gsfusion_nb/render/a.py",
        "timed out": "gsfusion_nb/render/a.py",
        "survived": "gsfusion_nb/tsdf/b.py",
    }
    verdicts = [
        {"verdict": v, "file": f, "line": 3, "original": v, "changed": "x"}
        for v, f in by_file.items()
    ]
    verdicts.append(verdicts[2] | {"file": "gsfusion_nb/render/a.py"})
    known = {
        ("gsfusion_nb/render/a.py", "survived", "x"): "equivalent",
        ("gsfusion_nb/render/a.py", "killed", "x"): "untested",
    }
    rooms = mutants.by_room(verdicts, known)
    assert rooms == {
        "render": {"killed": 1, "timed out": 1, "equivalent": 1},
        "tsdf": {"survived": 1},
    }
    assert {room: mutants.killed(counts) for room, counts in rooms.items()} == {
        "render": 100.0,
        "tsdf": 0.0,
    }
    text = mutants.report(verdicts, known)
    assert text.startswith("survived: gsfusion_nb/tsdf/b.py:3\n    - survived\n    + x\n\n")
    assert [line.split()[0] for line in text.splitlines()[-4:]] == [
        "room",
        "render",
        "tsdf",
        "together",
    ]
    assert [line.split()[-1] for line in text.splitlines()[-3:]] == ["100", "0", "67"]


def test_every_listed_survivor_is_a_line_of_its_file_and_has_a_reason():
    """A line that is gone takes its entry with it."""
    gone = [
        key
        for key, entry in mutants.entries().items()
        if not any(mutants.moved_to(mutants.ROOT, entry))
    ]
    assert gone == []
    assert all(len(entry["reason"]) > 10 for entry in mutants.entries().values())
