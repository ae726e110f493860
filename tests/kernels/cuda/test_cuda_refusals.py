"""What the kernels' own checks say; those of every backend for GPUs are in tests/kernels/gpu."""

import importlib

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.render import render_forward, render_vjp
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


def test_wrong_masks_shapes_and_records_are_named(make_scene, make_camera, pose, to):
    camera, params = make_camera(33, 17), to(make_scene(3, 0))
    everywhere = to(torch.ones(17, 33, dtype=torch.bool))
    with use_backend("cuda"):
        with pytest.raises(ValueError, match=r"pixels must be \[17, 33\], got \[33, 17\]"):
            render_forward(params, camera, pose, pixels=everywhere.T)
        _, saved = render_forward(params, camera, pose, pixels=everywhere)
        with pytest.raises(ValueError, match=r"rows must be boolean, got torch.float32"):
            render_vjp(saved, to(torch.zeros(17, 33, 3)), rows=to(torch.ones(3)))
        with pytest.raises(ValueError, match=r"v_rgb must be \[17, 33, 3\], got \[33, 17, 3\]"):
            render_vjp(saved, to(torch.zeros(33, 17, 3)))
        with pytest.raises(ValueError, match="the record that render_forward returns was expected, got str"):
            render_vjp("nothing", to(torch.zeros(17, 33, 3)))


def test_float64_goes_to_torch(make_scene, make_camera, pose, to):
    camera, p = make_camera(16, 16), to(make_scene(5, 0))
    params = GaussianParams(**{name: value.double() for name, value in vars(p).items()})
    with use_backend("cuda"):
        out, saved = render_forward(params, camera, to(pose).double())
        gradient = render_vjp(saved, torch.ones_like(out.rgb))
    assert out.rgb.dtype == gradient.xyz_W.dtype == torch.float64
