"""The student's copy of a notebook has no solution, no output, and the rest unchanged."""

import copy
import json
from pathlib import Path

import pytest

from gsfusion_nb.course.student import copy_course, main
from gsfusion_nb.course.without_solutions import without_solutions

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "notebooks").glob("*.ipynb"))


def code(source):
    return {"cell_type": "code", "metadata": {}, "source": source, "outputs": [{"x": 1}], "execution_count": 3}


def text(source):
    return {"cell_type": "markdown", "metadata": {}, "source": source}


SOLVED = "### BEGIN SOLUTION\ndef f(x):\n    return 2 * x\n### END SOLUTION"


def test_solutions_go_and_the_rest_stays():
    notebook = {
        "cells": [
            text("Double it."),
            code("def f(x):\n    ..."),
            code(SOLVED),
            code(["a = 1\n", "    ### BEGIN SOLUTION\n", "a = 2\n", "    ### END SOLUTION\n", "b = 3"]),
            text("Why?\n<!-- BEGIN SOLUTION -->\nBecause.\n<!-- END SOLUTION -->\nGo on."),
            code(""),
        ],
        "metadata": {"m": 1},
        "nbformat": 4,
    }
    before = copy.deepcopy(notebook)
    student = without_solutions(notebook)
    assert notebook == before
    sources = ["".join(cell["source"]) for cell in student["cells"]]
    assert sources == ["Double it.", "def f(x):\n    ...", "a = 1\nb = 3", "Why?\nGo on.", ""]
    assert all(
        c["outputs"] == [] and c["execution_count"] is None for c in student["cells"] if c["cell_type"] == "code"
    )
    assert {k: student[k] for k in ("metadata", "nbformat")} == {"metadata": {"m": 1}, "nbformat": 4}


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("### BEGIN SOLUTION\nx = 1", "cell 0 has BEGIN SOLUTION without END"),
        ("x = 1\n### END SOLUTION", "cell 0 has END SOLUTION without BEGIN"),
        ("### BEGIN SOLUTION\n### BEGIN SOLUTION\n### END SOLUTION", "inside a solution"),
    ],
)
def test_a_marker_without_its_partner_is_refused(source, says, tmp_path):
    path = tmp_path / "in" / "01_x.ipynb"
    path.parent.mkdir()
    path.write_text(json.dumps({"cells": [code(source)]}))
    with pytest.raises(ValueError, match=f"01_x.ipynb: .*{says}"):
        copy_course(path.parent, tmp_path / "out")


def test_refuses_to_overwrite_the_notebooks(tmp_path):
    with pytest.raises(ValueError, match="no notebook"):
        copy_course(tmp_path, tmp_path / "out")
    (tmp_path / "a.ipynb").write_text(json.dumps({"cells": []}))
    with pytest.raises(ValueError, match="would replace"):
        copy_course(tmp_path, tmp_path)


def test_the_command_copies_the_course(tmp_path, capsys):
    source = NOTEBOOKS[0].parent
    main([str(source), str(tmp_path / "student")])
    main([str(source), str(tmp_path / "teacher"), "--teacher"])
    for path in NOTEBOOKS:
        student = (tmp_path / "student" / path.name).read_text(encoding="utf-8")
        assert "SOLUTION" not in student
        assert json.loads(student)["cells"]
        assert (tmp_path / "teacher" / path.name).read_bytes() == path.read_bytes()
    with pytest.raises(SystemExit):
        main([str(tmp_path / "nowhere"), str(tmp_path / "out")])
    assert "no notebook" in capsys.readouterr().err
