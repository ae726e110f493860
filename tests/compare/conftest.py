"""The settings that map the small scene on disk (``scene``) fast."""

from unittest.mock import Mock

import pytest

from gsfusion_nb.compare import RunSpec, run_all
from gsfusion_nb.compare.admission import Admission
from gsfusion_nb.compare.program import look_at_program_again

SETTINGS = {
    "data.hold_out_every": 4,
    "data.hold_out_offset": 2,
    "tsdf.voxel_size_m": 0.08,
    "sh_degree": 0,
    "optim.global_iterations": 1,
    "optim.keyframe_iterations": 2,
    "optim.frame_iterations": 1,
    "optim.random_keyframe_iterations": 1,
    "seeding.quadtree_contrast": "std",
    "seeding.quadtree_threshold": 0.05,
}


@pytest.fixture
def spec(scene):
    """``spec(rule, **changes)``: a run on the small scene; ``settings`` are added to the fast
    ones."""

    def make(rule="uniform", settings=None, data=None, **changes):
        return RunSpec(
            rule=rule,
            scene="wall",
            data=data or str(scene),
            settings=SETTINGS | (settings or {}),
            **changes,
        )

    return make


@pytest.fixture(autouse=True)
def _entrants_are_trusted(request, monkeypatch):
    """The check of an entrant in a fresh process takes seconds: only tests that are about it make
    it."""
    if "fresh_checks" not in request.fixturenames:
        # no function of one's own, which would be seen as a change of the package
        monkeypatch.setattr(run_all, "admission", Mock(return_value=Admission()))


@pytest.fixture
def fresh_checks():
    """Entrants are checked in a fresh process, as in every comparison."""


@pytest.fixture
def same_torch_everywhere():
    """This process has torch as other processes have it, so that they have the same key."""
    look_at_program_again()  # an earlier test may have asked for the key of another torch
    yield
    look_at_program_again()
