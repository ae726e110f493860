"""The chapters as assignments for nbgrader and for Otter-Grader: points, solution cells and tests.

Neither program is needed for the export. Both then mark as they do any notebook, by the checks of the course.
"""

import copy
import json
import re
from pathlib import Path
from typing import Any, Literal

from ...files import read_object, write_file
from ..copies import without_solutions
from ..exercise import exercises
from .marks import Points

Target = Literal["nbgrader", "otter"]

_BEGIN, _END = "### BEGIN SOLUTION", "### END SOLUTION"
_CHECK = re.compile(r"^check\.(?P<name>\w+)\((?P=name)\)$")
_NBGRADER_CONFIG = '''"""Settings of nbgrader for the chapters of gsfusion-nb."""

import os

os.environ["GSNB_VIEW"] = "static"  # a submission that is marked leaves nothing in your own progress
c = get_config()  # noqa: F821
c.CourseDirectory.course_id = "gsfusion_nb"
c.ClearSolutions.code_stub = {"python": "# YOUR CODE HERE"}
c.OverwriteCells.add_missing_cells = True
c.Execute.timeout = 600  # seconds, of a cell
'''

_OTTER_CONFIG = """# ASSIGNMENT CONFIG
init_cell: true
export_cell: false
run_tests: false
tests:
    ok_format: true
"""


def export_course(notebooks: list[Path], target: Path, kind: Target, *, points: Points) -> list[Path]:
    """Write each chapter as an assignment into the folder ``target``. Returns the files written.

    Args:
        notebooks: The solved chapters.
        target: New or empty folder.
        kind: For nbgrader, a course folder with ``source`` and ``nbgrader_config.py``; for Otter, a folder for each
            chapter with the notebook that ``otter assign`` takes.
        points: The most points of each exercise.

    Raises:
        ValueError: no notebook, a folder that is not empty, or a notebook without exercises.
    """
    if not notebooks:
        raise ValueError("there is no notebook to export")
    if target.exists() and any(target.iterdir()):
        raise ValueError(f"{target} is not empty; name a new folder")
    written = []
    for path in notebooks:
        notebook = _without_told_solutions(read_object(path, "a notebook"))
        cells = assignment_cells(notebook["cells"], kind, points)
        if len(cells) == 0 or not any(_named(cell) for cell in notebook["cells"]):
            raise ValueError(f"{path} has no exercise")
        exported = {**notebook, "cells": _with_ids(cells)}
        folder = target / "source" / path.stem if kind == "nbgrader" else target / path.stem
        written.append(folder / path.name)
        write_file(written[-1], json.dumps(exported, indent=1, ensure_ascii=False) + "\n")
    if kind == "nbgrader":
        written.append(target / "nbgrader_config.py")
        write_file(written[-1], _NBGRADER_CONFIG)
    return written


def assignment_cells(cells: list[dict[str, Any]], kind: Target, points: Points) -> list[dict[str, Any]]:
    """The cells of a solved chapter with the solutions, tests and points marked as ``kind`` wants them."""
    made: list[dict[str, Any]] = [] if kind == "nbgrader" else [_raw(_OTTER_CONFIG)]
    for cell in copy.deepcopy(cells):
        source = "".join(cell["source"])
        if cell["cell_type"] == "code":
            cell |= {"outputs": [], "execution_count": None}
        name = _named(cell)
        if cell["cell_type"] == "code" and _BEGIN in source:
            _join_to_stub(made, source)
        elif name is None:
            made.append(cell)
        elif kind == "nbgrader":
            made.append(_nbgrader_test(made, cell, name, points))
        else:
            _otter_question(made, cell, name, points)
    return made


def _without_told_solutions(notebook: dict[str, Any]) -> dict[str, Any]:
    """The notebook without solutions in its text cells; those in code cells are for the other program to take out."""
    text = [cell for cell in notebook["cells"] if cell["cell_type"] != "code"]
    left = {cell.get("id"): cell for cell in without_solutions({"cells": text})["cells"]}
    cells = [c if c["cell_type"] == "code" else left.get(c.get("id")) for c in notebook["cells"]]
    return {**notebook, "cells": [cell for cell in cells if cell is not None]}


def _named(cell: dict[str, Any]) -> str | None:
    """The exercise whose answer a cell checks."""
    match = _CHECK.match("".join(cell["source"]).strip()) if cell["cell_type"] == "code" else None
    return match["name"] if match and match["name"] in exercises() else None


def _join_to_stub(made: list[dict[str, Any]], solution: str) -> None:
    """Put a solution into the cell above in which the student writes the function."""
    defined = re.search(r"^def (\w+)\(", solution, re.MULTILINE)
    for cell in reversed(made):
        if defined and cell["cell_type"] == "code" and f"def {defined[1]}(" in "".join(cell["source"]):
            cell["source"] = "".join(cell["source"]).rstrip("\n") + "\n\n\n" + solution
            return
    raise ValueError(f"there is no cell in which the solution {defined[1] if defined else ''} is to be written")


def _stub(made: list[dict[str, Any]], name: str) -> int:
    """Where the cell is in which the student writes ``name``."""
    return max(i for i, c in enumerate(made) if c["cell_type"] == "code" and f"def {name}(" in "".join(c["source"]))


def _nbgrader_test(made: list[dict[str, Any]], cell: dict[str, Any], name: str, points: Points) -> dict[str, Any]:
    """The cell with the tests of an exercise; marks the cell of its answer."""
    common = {"schema_version": 3, "task": False}
    answer = {"grade": False, "grade_id": f"answer-{name}", "locked": False, "solution": True}
    made[_stub(made, name)]["metadata"]["nbgrader"] = answer | common
    most = points.of(exercises()[name])
    test = {"grade": True, "grade_id": f"test-{name}", "locked": True, "solution": False, "points": most}
    cell["metadata"]["nbgrader"] = test | common
    cell["source"] = f"assert check.{name}({name}), check.{name}({name})"
    return cell


def _otter_question(made: list[dict[str, Any]], cell: dict[str, Any], name: str, points: Points) -> None:
    """Put the raw cells of a question around the cell of its answer, and its tests after it."""
    at = _stub(made, name)
    answer = made[at]
    source = "".join(answer["source"])
    answer["source"] = source.replace(_BEGIN, "# BEGIN SOLUTION NO PROMPT").replace(_END, "# END SOLUTION")
    most = points.of(exercises()[name])
    made[at : at + 1] = [
        _raw(f"# BEGIN QUESTION\nname: {name}\npoints: {most:g}\nall_or_nothing: true"),
        _raw("# BEGIN SOLUTION"), answer, _raw("# END SOLUTION"),
        _raw("# BEGIN TESTS"), _shows_true(f"bool(check.{name}({name}))"), _raw("# END TESTS"),
        _raw("# END QUESTION"),
    ]  # fmt: skip
    made.append(cell)


def _raw(source: str) -> dict[str, Any]:
    return {"cell_type": "raw", "metadata": {}, "source": source}


def _shows_true(source: str) -> dict[str, Any]:
    output = {"output_type": "execute_result", "execution_count": 1, "metadata": {}, "data": {"text/plain": "True"}}
    return {"cell_type": "code", "metadata": {}, "source": source, "outputs": [output], "execution_count": 1}


def _with_ids(cells: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{"id": f"export-{i}", **cell} for i, cell in enumerate(cells)]
