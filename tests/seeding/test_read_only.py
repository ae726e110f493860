"""What a rule may only read cannot be changed by it, with torch, with NumPy, or by giving it
another value."""

import dataclasses
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.seeding import apply_rule, orb_corners, raycast_volume
from gsfusion_nb.seeding.bound_rule import bound_rule
from gsfusion_nb.seeding.check_scenes import check_contexts
from gsfusion_nb.seeding.input_guard import ChangedInputError, context_tensors, unchanged_inputs
from gsfusion_nb.seeding.read_only import read_only


@pytest.fixture(scope="module")
def real():
    return check_contexts()["real map"]


@pytest.fixture
def ctx(real):
    """A frame with a map, a volume and a keyframe."""
    frame = real.frame
    images = {name: getattr(frame, name).clone() for name in ("rgb_u8", "depth_m", "T_WC")}
    return dataclasses.replace(
        real, keyframes=(SimpleNamespace(index=0, camera=frame.camera, **images),)
    )


def fill(tensor):
    tensor.numpy()[...] = 0


def blurred(tensor):
    cv2.blur(tensor.numpy(), (3, 3), dst=tensor.numpy())


WRITES = {
    "TSDF by NumPy": ("volume.D", lambda ctx: fill(ctx.volume.D)),
    "TSDF by np.asarray": ("volume.W", lambda ctx: np.asarray(ctx.volume.W).fill(0)),
    "part of the TSDF": ("volume.D", lambda ctx: fill(ctx.volume.D[1:])),
    "TSDF by np.copyto": ("volume.D", lambda ctx: np.copyto(ctx.volume.D.numpy(), 0)),
    "TSDF by torch": ("volume.D", lambda ctx: ctx.volume.D.mul_(1)),
    "keyframe by NumPy": ("keyframes[0].rgb_u8", lambda ctx: fill(ctx.keyframes[0].rgb_u8)),
    "keyframe by OpenCV": ("keyframes[0].depth_m", lambda ctx: blurred(ctx.keyframes[0].depth_m)),
    "another image of a keyframe": (
        "keyframes[0].depth_m",
        lambda ctx: vars(ctx.keyframes[0]).update(depth_m=None),
    ),
    "map by NumPy": ("map.xyz_W", lambda ctx: fill(ctx.gaussians.params.xyz_W)),
    "a Gaussian more": ("map.xyz_W", lambda ctx: ctx.gaussians.append(ctx.cells(), 5)),
    "frame by NumPy": ("frame.depth_m", lambda ctx: fill(ctx.frame.depth_m)),
    "another image of the frame": (
        "frame.extra['x']",
        lambda ctx: ctx.frame.extra.update(x=torch.ones(1)),
    ),
}


@pytest.mark.parametrize(("what", "write"), WRITES.values(), ids=WRITES)
def test_a_change_is_refused(ctx, what, write):
    def rule(ctx):
        write(ctx)
        return ctx.seeds_at(ctx.pixels(), 1.0)

    ctx = dataclasses.replace(ctx, gaussians=check_contexts()["real map"].gaussians)
    with pytest.raises(ChangedInputError) as caught:
        apply_rule(rule, ctx)
    assert caught.value.what == what


def test_after_each_step_no_array_can_be_written_to(ctx):
    """There sums over the whole map would take too long."""
    mine = bound_rule(lambda ctx: ctx.cells(), {})
    for what, write in (
        ("map.xyz_W", lambda: fill(ctx.gaussians.params.xyz_W)),
        ("frame.depth_m", lambda: fill(ctx.frame.depth_m)),
    ):
        with (
            pytest.raises(ChangedInputError) as caught,
            unchanged_inputs(ctx, mine, is_quick=True),
        ):
            write()
        assert caught.value.what == what


def test_reading_and_copies_are_free(ctx):
    def rule(ctx):
        for _, tensor in context_tensors(ctx):
            copy = tensor.numpy().copy()
            copy[...] = 0
            other = tensor.clone().numpy()
            other[...] = 0
            assert np.asarray(tensor, dtype=np.float64).flags.writeable
            assert np.from_dlpack(tensor).shape == tensor.shape
        raycast_volume(ctx)
        orb_corners(ctx.frame, 1000)
        ctx.render()
        ctx.edges()
        return ctx.seeds_at(ctx.pixels(), 1.0)

    assert len(apply_rule(rule, ctx)) > 0


def test_an_error_of_the_rule_stays_its_own(ctx):
    def rule(ctx):
        raise ValueError("no such thing as a read-only depth")

    with pytest.raises(ValueError, match="no such thing") as caught:
        apply_rule(rule, ctx)
    assert not isinstance(caught.value, ChangedInputError)


def test_writing_past_numpy_is_written_to_a_copy():
    tensor = torch.ones(3)
    with read_only([("x", tensor)]):
        np.from_dlpack(tensor)[:] = 0
    assert tensor.tolist() == [1, 1, 1]


def test_arrays_are_as_before_afterwards():
    tensor = torch.ones(3)
    before = (torch.Tensor.numpy, torch.Tensor.__array__)
    with read_only([("x", tensor)]) as made:
        assert not tensor.numpy().flags.writeable
        assert torch.ones(3).numpy().flags.writeable
        with read_only([]):
            assert tensor.numpy().flags.writeable
        assert not tensor[1:].numpy().flags.writeable
    assert made == ["x", "x"]
    assert tensor.numpy().flags.writeable
    assert (torch.Tensor.numpy, torch.Tensor.__array__) == before
