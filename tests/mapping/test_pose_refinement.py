"""Poses that are off by millimetres come closer to the truth while mapping, and nothing else moves."""

import copy
import dataclasses
from typing import Any

import pytest
import torch

from gsfusion_nb import GSFusion, gsfusion
from gsfusion_nb.data.room import room
from gsfusion_nb.geometry import se3

SMALL: dict[str, Any] = {
    "tsdf__voxel_size_m": 0.04,
    "seeding__quadtree_threshold": 0.03,
    "seeding__quadtree_contrast": "std",
    "keyframe_every": 1,
    "optim__global_iterations": 4,
}


@pytest.fixture(scope="module")
def walk():
    """Frames with poses that are off by 1 cm and 0.6 degrees about each axis, and the true poses."""
    sequence, generator = room(n_frames=240, width=80, height=60), torch.Generator().manual_seed(0)
    off = [se3.exp(0.01 * torch.randn(6, generator=generator)) for _ in range(12)]
    frames = [dataclasses.replace(sequence[i], T_WC=sequence.pose(i) @ off[i]) for i in range(12)]
    return [sequence.pose(i) for i in range(12)], frames


def mapped(frames, refine, **settings):
    mapper = GSFusion(gsfusion("replica", optim__refine_poses=refine, **SMALL | settings))
    for frame in frames:
        mapper.step(frame)
    return mapper


def error(true, poses):
    """Mean error of the rotations, degrees; the map as a whole may be turned."""
    pairs = zip(true, poses, strict=True)
    omega = torch.stack([se3.log(b.double() @ se3.inverse(a.double()))[3:] for a, b in pairs])
    return float((omega - omega.mean(0)).norm(dim=1).mean().rad2deg())


def test_poses_come_closer_to_the_truth_and_the_given_ones_remain(walk):
    true, frames = walk
    mapper = mapped(frames, True)
    for _ in mapper.global_optimise():
        pass
    given = [frame.T_WC for frame in frames]
    assert all(torch.equal(a, b) for a, b in zip(mapper.localiser.given, given, strict=True))
    assert error(true, mapper.localiser.poses) < 0.9 * error(true, given)
    for keyframe in mapper.keyframes:
        row = mapper.localiser.frame_indices.index(keyframe.index)
        assert torch.equal(keyframe.T_WC, mapper.localiser.poses[row])


def test_a_resumed_run_has_the_same_poses_bit_for_bit(walk, same):
    _, frames = walk
    whole = mapped(frames[:7], True)
    part = GSFusion.from_state_dict(copy.deepcopy(whole.state_dict()))
    for mapper in (whole, part):
        mapper.step(frames[7])
        passes = mapper.global_optimise()
        for _ in range(10):  # more than one pass over the 8 keyframes
            next(passes)
    again = GSFusion.from_state_dict(copy.deepcopy(part.state_dict()))
    for mapper in (whole, again):
        for _ in mapper.global_optimise(1):
            pass
    same(whole.state_dict(), again.state_dict())


def test_the_mean_motion_is_taken_back_from_map_and_keyframes(walk):
    _, frames = walk
    mapper = mapped(frames[:4], True)
    G = se3.exp(torch.tensor([0.01, -0.02, 0.005, 0.01, 0.0, -0.01]))
    xyz_W = mapper.gaussians.params.xyz_W.clone()
    mapper.gaussians.move(G.expand(len(xyz_W), 4, 4))
    mapper.keyframes.move(G.expand(len(mapper.keyframes), 4, 4))
    for k in mapper.keyframes:
        mapper.localiser.refine(k.index, k.T_WC)
    mapper.fits.end_pass(mapper.keyframes, mapper.gaussians)
    torch.testing.assert_close(mapper.gaussians.params.xyz_W, xyz_W, atol=1e-5, rtol=0)
    for k in mapper.keyframes:
        torch.testing.assert_close(k.T_WC, frames[k.index].T_WC, atol=1e-5, rtol=0)


def test_frames_between_keyframes_follow_them(walk):
    _, frames = walk
    mapper = mapped(frames[:5], True, keyframe_every=4)
    for _ in mapper.global_optimise(1):
        pass
    localiser, given = mapper.localiser, [frame.T_WC for frame in frames]
    xi = [se3.log(se3.inverse(a.double()) @ b.double()) for a, b in zip(given, localiser.poses, strict=False)]
    assert [k.index for k in mapper.keyframes] == [0, 4]
    assert xi[4].norm() > 1e-4
    torch.testing.assert_close(xi[1], 0.75 * xi[0] + 0.25 * xi[4], atol=1e-6, rtol=0)
    torch.testing.assert_close(localiser.refined(1, given[1]), localiser.poses[1])
    beyond = se3.log(se3.inverse(given[7].double()) @ localiser.refined(7, given[7]).double())
    torch.testing.assert_close(beyond, xi[4], atol=1e-6, rtol=0)
