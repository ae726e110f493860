"""What the kernels' own checks say; those of every backend for GPUs are in tests/kernels/gpu."""

import importlib

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.render import render_forward
from gsfusion_nb.types import GaussianParams


@pytest.fixture
def launch():
    return importlib.import_module("gsfusion_nb.kernels.runtime.cuda.launch")


def test_tensors_with_gaps_are_refused(launch, device):
    gaps = torch.zeros(4, 4, device=device)[:, ::2]
    with pytest.raises(ValueError, match=r"add: tensors without gaps were expected, got strides \(4, 2\)"):
        launch.launch("add", "binning:count_tiles", 1, 32, gaps)


def test_types_and_degrees_are_named(make_scene, make_camera, pose, to):
    params = make_scene(3, 0)
    mixed = GaussianParams(**{**vars(params), "quat": params.quat.half()})
    between = GaussianParams(**{**vars(params), "sh": params.sh.repeat(1, 2, 1)})
    with use_backend("cuda"):
        with pytest.raises(ValueError, match=r"quat must be torch.float32, got torch.float16"):
            render_forward(to(mixed), make_camera(16, 16), pose)
        with pytest.raises(ValueError, match="K = 1, 4, 9 or 16"):
            render_forward(to(between), make_camera(16, 16), pose)


def test_a_failed_launch_names_the_operation(launch, device):
    """A grid that no device takes."""
    with pytest.raises(ValueError, match=r"add: .* blocks of work are more than a GPU takes at once"):
        launch.launch("add", "binning:count_tiles", (1, 1 << 20), 32, torch.zeros(3, device=device))
