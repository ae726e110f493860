"""The exposures of keyframes are found while their map is optimised, and stay 1 on average."""

import copy
import dataclasses

import pytest
import torch

from gsfusion_nb import GSFusion, gsfusion
from gsfusion_nb.data.room import room
from gsfusion_nb.mapping.training import exposure_between


def mapped(frames, **optim):
    config = gsfusion(
        "replica", tsdf__voxel_size_m=0.04, seeding__quadtree_threshold=0.03, seeding__quadtree_contrast="std",
        keyframe_every=1, optim__global_iterations=5, **{f"optim__{name}": value for name, value in optim.items()},
    )  # fmt: skip
    mapper = GSFusion(config)
    for frame in frames:
        mapper.step(frame)
    return mapper


@pytest.fixture(scope="module")
def flicker():
    """Eight frames close together; every second one is darker, most of all in blue."""
    sequence = room(n_frames=480, width=80, height=60)
    dark = torch.tensor([0.85, 0.8, 0.75])
    frames = [sequence[i] for i in range(8)]
    return dark, [dataclasses.replace(f, rgb=f.rgb * dark) if f.index % 2 else f for f in frames]


def test_relative_exposures_are_found_and_their_mean_is_one(flicker):
    dark, frames = flicker
    mapper = mapped(frames, fit_exposure=True)
    for _ in mapper.global_optimise():
        pass
    gains = torch.stack([k.gain for k in mapper.keyframes if k.gain is not None])
    torch.testing.assert_close(gains.log().mean(0), torch.zeros(3), atol=1e-6, rtol=0)
    found = gains[1::2].log().mean(0) - gains[::2].log().mean(0)
    torch.testing.assert_close(found.exp(), dark, atol=0.03, rtol=0)


def test_a_resumed_run_goes_on_bit_for_bit_and_without_the_setting_nothing_is_fitted(flicker, same):
    _, frames = flicker
    whole = mapped(frames[:4], fit_exposure=True, refine_poses=True)
    passes = whole.global_optimise()
    for _ in range(6):
        next(passes)
    again = GSFusion.from_state_dict(copy.deepcopy(whole.state_dict()))
    for mapper in (whole, again):
        for _ in mapper.global_optimise(1):
            pass
    same(whole.state_dict(), again.state_dict())
    plain = mapped(frames[:2])
    next(plain.global_optimise())
    assert [k.gain for k in plain.keyframes] == [None, None]


def test_a_view_between_two_has_an_exposure_between_theirs_in_stops():
    first, last = torch.tensor([0.5, 1.0, 2.0]), torch.tensor([2.0, 1.0, 0.5])
    torch.testing.assert_close(exposure_between({4: last, 2: first}, 3), torch.ones(3))
    torch.testing.assert_close(exposure_between({4: last, 2: first}, 1), first)  # the first one's
    torch.testing.assert_close(exposure_between({2: first}, 9), first)
