"""Which tensors the backends for GPUs take, and what they say of others."""

import importlib

import pytest
import torch

from gsfusion_nb.backends import BackendUnavailable, use_backend
from gsfusion_nb.render import render_forward, render_vjp
from gsfusion_nb.types import GaussianParams


@pytest.fixture
def launch(backend):
    return importlib.import_module(f"gsfusion_nb.kernels.runtime.{backend}.launch")


def test_tensors_on_two_devices_are_refused(launch, device):
    here, elsewhere = torch.zeros(3, device=device), torch.zeros(3, device="meta")
    with pytest.raises(ValueError, match=f"add: all tensors must be on one device, got a on {device}.*, b on meta"):
        launch.device_of("add", a=here, b=elsewhere)


def test_other_devices_are_refused(launch, backend):
    with pytest.raises(BackendUnavailable, match=f"add: backend '{backend}' takes CUDA tensors, got tensors on meta"):
        launch.device_of("add", a=torch.zeros(3, device="meta"), b=None)


def test_wrong_masks_shapes_and_records_are_named(backend, make_scene, make_camera, pose, to):
    camera, params = make_camera(33, 17), to(make_scene(3, 0))
    everywhere = to(torch.ones(17, 33, dtype=torch.bool))
    with use_backend(backend):
        with pytest.raises(ValueError, match=r"pixels must be \[17, 33\], got \[33, 17\]"):
            render_forward(params, camera, pose, pixels=everywhere.T)
        _, saved = render_forward(params, camera, pose, pixels=everywhere)
        with pytest.raises(ValueError, match=r"rows must be boolean, got torch.float32"):
            render_vjp(saved, to(torch.zeros(17, 33, 3)), rows=to(torch.ones(3)))
        with pytest.raises(ValueError, match=r"v_rgb must be \[17, 33, 3\], got \[33, 17, 3\]"):
            render_vjp(saved, to(torch.zeros(33, 17, 3)))
        with pytest.raises(ValueError, match="the record that render_forward returns was expected, got str"):
            render_vjp("nothing", to(torch.zeros(17, 33, 3)))


def test_float64_goes_to_the_reference(backend, make_scene, make_camera, pose, to):
    camera, p = make_camera(16, 16), to(make_scene(5, 0))
    params = GaussianParams(**{name: value.double() for name, value in vars(p).items()})
    with use_backend(backend):
        out, saved = render_forward(params, camera, to(pose).double())
        gradient = render_vjp(saved, torch.ones_like(out.rgb))
    assert out.rgb.dtype == gradient.xyz_W.dtype == torch.float64
