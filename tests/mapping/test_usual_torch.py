"""A mapper takes frames and gives pictures in any mode of torch, with the same map."""

import contextlib
import dataclasses

import pytest
import torch

from gsfusion_nb.data.room import room
from gsfusion_nb.mapping import SYSTEMS, make_mapper

STEPS = {
    "gsfusion": {"optim__global_iterations": 1, "tsdf__voxel_size_m": 0.05, "sh_degree": 0},
    "rtg_slam": {"final__passes": 1, "sh_degree": 0},
    "gps_slam": {"final__passes": 1, "tsdf__voxel_size_m": 0.05},
}


@contextlib.contextmanager
def float64():
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


def mapped(system, modes):
    """A map of ten frames: made and taken through each of its stages in one of the modes, in
    turn."""
    walk = room(n_frames=240, width=64, height=48)
    with modes[0]():
        mapper = make_mapper(SYSTEMS[system].preset("room", **STEPS[system]))
    for i in range(10):
        with modes[i % len(modes)]():
            mapper.step(walk[i])
            picture = mapper.render(walk[i].camera, walk[i].T_WC)
    with modes[0]():
        mapper.surface(walk[0].camera, walk[0].T_WC)
        mapper = type(mapper).from_state_dict(mapper.state_dict())
    for n, _ in enumerate(mapper.global_optimise()):
        with modes[n % len(modes)]():
            mapper.mesh()
    return mapper, picture


MODES = {
    "inference mode": [torch.inference_mode],
    "inference mode, now and then": [
        contextlib.nullcontext,
        torch.inference_mode,
        contextlib.nullcontext,
    ],
    "inference mode first": [torch.inference_mode, contextlib.nullcontext],
    "float64 by default": [float64],
}


@pytest.mark.parametrize("system", SYSTEMS)
def test_the_map_is_the_same_in_every_mode(system):
    expected, picture = mapped(system, [contextlib.nullcontext])
    for name, modes in MODES.items():
        mapper, seen = mapped(system, modes)
        assert torch.equal(seen.rgb, picture.rgb), name
        for column, value in vars(expected.gaussians.params).items():
            assert torch.equal(getattr(mapper.gaussians.params, column), value), (name, column)
    assert torch.get_default_dtype() == torch.float32
    assert not torch.is_inference_mode_enabled()


def test_the_default_of_torch_is_given_back_after_an_error():
    walk = room(n_frames=240, width=64, height=48)
    mapper = make_mapper(SYSTEMS["gsfusion"].preset("room", **STEPS["gsfusion"]))
    with float64():
        with pytest.raises(ValueError, match="is black"):
            mapper.step(dataclasses.replace(walk[0], rgb=torch.zeros_like(walk[0].rgb)))
        assert torch.get_default_dtype() == torch.float64
