"""Slips of a student: one piece of a right answer replaced by a wrong one. Every judge refuses them and names why.

``slips.json``: exercise -> [what stands in the notebook's solution, what the student wrote, the property that fails].
"""

import functools
import heapq
import inspect
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from gsfusion_nb.geometry import quaternion
from gsfusion_nb.teaching import exercises
from gsfusion_nb.teaching.attempt import Attempt, Failed
from gsfusion_nb.teaching.rtg_slam import BECOMES_STABLE, BECOMES_UNSTABLE, DELETED, STAYS

ALL = exercises()
SLIPS = json.loads(Path(__file__).with_name("slips.json").read_text(encoding="utf-8"))
NOTEBOOKS = Path(__file__).resolve().parents[2] / "notebooks"
SOLUTION = re.compile(r"### BEGIN SOLUTION\n(.*)### END SOLUTION", re.DOTALL)
OF_THE_NOTEBOOK = {
    "contrast_of": ALL["contrast"]._solution, "part_of": ALL["split_cell"]._solution, "quaternion": quaternion,
    "STABLE": BECOMES_STABLE, "UNSTABLE": BECOMES_UNSTABLE, "DELETED": DELETED, "STAYS": STAYS,
    "torch": torch, "np": np, "math": math, "heapq": heapq,
}  # fmt: skip


@functools.cache
def solution_cells():
    """Exercise -> source of its solution in the notebook."""
    cells = {}
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] != "code" or not (found := SOLUTION.search("".join(cell["source"]))):
                continue
            for name in re.findall(r"^def (\w+)\(", found[1], re.MULTILINE):
                cells.setdefault(name, found[1])
    return cells


def written(name, source):
    """The function that a student gets who runs ``source`` in a cell."""
    namespace = {**inspect.unwrap(ALL[name]._solution).__globals__, **OF_THE_NOTEBOOK}
    exec(compile(source, f"<{name}>", "exec"), namespace)
    return namespace[name]


@pytest.mark.parametrize("name", ALL)
def test_the_notebooks_solution_passes(name):
    verdict = ALL[name](written(name, solution_cells()[name]))
    assert verdict, repr(verdict)


@pytest.mark.parametrize("name", SLIPS)
@pytest.mark.filterwarnings("ignore")
def test_a_slip_is_refused_with_its_reason(name):
    solution = solution_cells()[name]
    for right, wrong, says in SLIPS[name]:
        assert right in solution, f"{right!r} is not in the solution any more"
        with pytest.raises(Failed) as e:
            ALL[name].judge(Attempt(written(name, solution.replace(right, wrong))))
        assert e.value.prop == says, f"{right!r} -> {wrong!r}: {e.value}"
        assert e.value.on
        assert e.value.detail


def test_there_are_many():
    assert sum(map(len, SLIPS.values())) >= 400
    assert set(ALL) <= set(SLIPS)
