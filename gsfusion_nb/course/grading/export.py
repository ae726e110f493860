"""The chapters as assignments for nbgrader: points, solution cells and tests.

nbgrader is not needed for the export. It then marks as it does any notebook, by the checks of the
course.
"""

import copy
import json
import re
from pathlib import Path
from typing import Any

from ...errors import ArgumentError
from ...files import read_object, write_file
from ..copies import without_solutions
from ..exercise import exercises
from .marks import BY_DIFFICULTY

_BEGIN = "### BEGIN SOLUTION"
_END = "### END SOLUTION"
_CHECK = re.compile(r"^check\.(?P<name>\w+)\((?P=name)\)$")
_NBGRADER_CONFIG = '''"""Settings of nbgrader for the chapters of gsfusion-nb."""

import os

# a submission that is marked leaves nothing in your own progress
os.environ["GSNB_VIEW"] = "static"
c = get_config()  # noqa: F821
c.CourseDirectory.course_id = "gsfusion_nb"
c.ClearSolutions.code_stub = {"python": "# YOUR CODE HERE"}
c.OverwriteCells.add_missing_cells = True
c.Execute.timeout = 600  # seconds, of a cell
'''


def export_course(notebooks: list[Path], target: Path) -> list[Path]:
    """Write a course folder of nbgrader, with ``source`` and ``nbgrader_config.py``. Returns the
    files written.

    Args:
        notebooks: The solved chapters.
        target: A folder, which may hold other files, such as the notebooks of ``make lab``.

    Raises:
        ValueError: no notebook, a file that would be replaced, or a notebook without exercises.
    """
    if not notebooks:
        raise ArgumentError("there is no notebook to export")
    config = target / "nbgrader_config.py"
    for path in (config, *(target / "source" / path.stem for path in notebooks)):
        if path.exists():
            raise ArgumentError(f"{path} is there already; rename it, or name another folder")
    paths = []
    for path in notebooks:
        notebook = _without_told_solutions(read_object(path, "a notebook"))
        cells = assignment_cells(notebook["cells"])
        if len(cells) == 0 or not any(_exercise_of(cell) for cell in notebook["cells"]):
            raise ArgumentError(f"{path} has no exercise")
        names = {
            **notebook,
            "cells": [{"id": f"export-{i}", **cell} for i, cell in enumerate(cells)],
        }
        paths.append(target / "source" / path.stem / path.name)
        write_file(
            paths[-1],
            json.dumps(names, indent=1, ensure_ascii=False) + "\n",
        )
    paths.append(config)
    write_file(paths[-1], _NBGRADER_CONFIG)
    return paths


def assignment_cells(cells: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The cells of a solved chapter with the solutions, tests and points marked as nbgrader wants
    them."""
    assignment: list[dict[str, Any]] = []
    for cell in copy.deepcopy(cells):
        source = "".join(cell["source"])
        if cell["cell_type"] == "code":
            cell |= {"outputs": [], "execution_count": None}
        name = _exercise_of(cell)
        if cell["cell_type"] == "code" and _BEGIN in source:
            _join_to_stub(assignment, source)
        elif name is None:
            assignment.append(cell)
        else:
            assignment.append(_nbgrader_test(assignment, cell, name))
    return assignment


def _without_told_solutions(notebook: dict[str, Any]) -> dict[str, Any]:
    """The notebook without solutions in its text cells; those in code cells are for nbgrader to
    take out."""
    text = [cell for cell in notebook["cells"] if cell["cell_type"] != "code"]
    texts = {cell.get("id"): cell for cell in without_solutions({"cells": text})["cells"]}
    cells = [c if c["cell_type"] == "code" else texts.get(c.get("id")) for c in notebook["cells"]]
    return {**notebook, "cells": [cell for cell in cells if cell is not None]}


def _exercise_of(cell: dict[str, Any]) -> str | None:
    """The exercise whose answer a cell checks."""
    match = _CHECK.match("".join(cell["source"]).strip()) if cell["cell_type"] == "code" else None
    return match["name"] if match and match["name"] in exercises() else None


def _join_to_stub(cells: list[dict[str, Any]], solution: str) -> None:
    """Put a solution into the cell above in which the student writes the function."""
    definition = re.search(r"^def (\w+)\(", solution, re.MULTILINE)
    for cell in reversed(cells):
        if (
            definition
            and cell["cell_type"] == "code"
            and f"def {definition[1]}(" in "".join(cell["source"])
        ):
            cell["source"] = "".join(cell["source"]).rstrip("\n") + "\n\n\n" + solution
            return
    name = definition[1] if definition else ""
    raise ArgumentError(f"there is no cell in which the solution {name} is to be written")


def _nbgrader_test(
    cells: list[dict[str, Any]],
    cell: dict[str, Any],
    name: str,
) -> dict[str, Any]:
    """The cell with the tests of an exercise; marks the cell of its answer."""
    common = {"schema_version": 3, "task": False}
    answer = {"grade": False, "grade_id": f"answer-{name}", "locked": False, "solution": True}
    (*_, stub) = (
        c for c in cells if c["cell_type"] == "code" and f"def {name}(" in "".join(c["source"])
    )
    _put_before(cells, stub, name)
    stub["metadata"]["nbgrader"] = answer | common
    most = BY_DIFFICULTY[exercises()[name].difficulty]
    test = {
        "grade": True,
        "grade_id": f"test-{name}",
        "locked": True,
        "solution": False,
        "points": most,
    }
    cell["metadata"]["nbgrader"] = test | common
    cell["source"] = f"assert check.{name}({name}), check.{name}({name})"
    return cell


def _put_before(cells: list[dict[str, Any]], stub: dict[str, Any], name: str) -> None:
    """Put what stands above the function into a cell of its own: the cell of an answer holds what
    the student writes, and nothing that others need."""
    before, definition, rest = "".join(stub["source"]).partition(f"def {name}(")
    if before.strip():
        stub["source"] = definition + rest
        helper = {**copy.deepcopy(stub), "id": f"before-{name}", "source": before.rstrip("\n")}
        place = next(i for i, cell in enumerate(cells) if cell is stub)
        cells.insert(place, helper)
