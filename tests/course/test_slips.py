"""Slips of a student: one piece of a right answer replaced by a wrong one. Every judge refuses them
and names why.

``slips.json``: exercise -> [what stands in the notebook's solution, what the student wrote, the
property that fails].
"""

import heapq
import inspect
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from gsfusion_nb.course import exercises
from gsfusion_nb.course.attempt import Attempt, Failed, LocalSubject
from gsfusion_nb.course.surfel_states import BECOMES_STABLE, BECOMES_UNSTABLE, DELETED, STAYS
from gsfusion_nb.geometry import quaternion

ALL = exercises()
SLIPS = json.loads(Path(__file__).with_name("slips.json").read_text(encoding="utf-8"))
NOTEBOOKS = Path(__file__).resolve().parents[2] / "notebooks"
OF_THE_NOTEBOOK = {
    "contrast_of": ALL["contrast"]._solution,
    "part_of": ALL["split_cell"]._solution,
    "quaternion": quaternion,
    "STABLE": BECOMES_STABLE,
    "UNSTABLE": BECOMES_UNSTABLE,
    "DELETED": DELETED,
    "STAYS": STAYS,
    "torch": torch,
    "np": np,
    "math": math,
    "heapq": heapq,
}


@pytest.fixture(scope="module")
def solutions(solutions_in):
    """Exercise -> source of its solution in the notebook."""
    notebooks = [
        json.loads(path.read_text(encoding="utf-8")) for path in sorted(NOTEBOOKS.glob("*.ipynb"))
    ]
    return {
        name: source for notebook in notebooks for name, source in solutions_in(notebook).items()
    }


def written(name, source):
    """The function that a student gets who runs ``source`` in a cell."""
    namespace = {**inspect.unwrap(ALL[name]._solution).__globals__, **OF_THE_NOTEBOOK}
    exec(compile(source, f"<{name}>", "exec"), namespace)
    return namespace[name]


@pytest.mark.parametrize("name", ALL)
def test_the_notebooks_solution_passes(name, solutions):
    verdict = ALL[name](written(name, solutions[name]))
    assert verdict, repr(verdict)


@pytest.mark.parametrize("name", SLIPS)
@pytest.mark.filterwarnings("ignore")
def test_a_slip_is_refused_with_its_reason(name, solutions):
    solution = solutions[name]
    for right, wrong, says in SLIPS[name]:
        assert right in solution, f"{right!r} is not in the solution any more"
        with pytest.raises(Failed) as e:
            ALL[name].judge(Attempt(LocalSubject(written(name, solution.replace(right, wrong)))))
        assert e.value.prop == says, f"{right!r} -> {wrong!r}: {e.value}"
        assert e.value.on
        assert e.value.detail
