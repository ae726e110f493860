"""Points of one depth image seen from another."""

import pytest
import torch

from gsfusion_nb.data.adjust.depth_agreement import depth_consistency, depth_pair, relative_poses, thinned
from gsfusion_nb.geometry import depth_to_points, se3
from gsfusion_nb.types import Camera

CAMERA = Camera(width=8, height=6, fx=8.0, fy=8.0, cx=4.0, cy=3.0)


def test_a_wall_by_hand():
    wall = torch.full((6, 8), 2.0)
    pair = depth_pair(wall, wall, CAMERA, step=1)
    assert pair.xyz_a.shape == (48, 3)
    still, nearer, aside, behind = torch.eye(4).repeat(4, 1, 1)
    nearer[2, 3] = -0.03  # 1.5 % of 2 m: half of what counts as agreeing
    aside[0, 3] = 1.0  # a pixel is 0.25 m wide there: four of eight columns leave
    behind[2, 3] = -3.0
    found = depth_consistency(pair, torch.stack([still, nearer, aside, behind]))
    assert found.agreeing.tolist() == [1.0, 1.0, 0.5, 0.0]
    assert found.overlap.tolist() == [1.0, 1.0, 0.5, 0.0]
    assert found.score.tolist() == pytest.approx([1.0, 0.5, 0.5, 0.0], abs=1e-5)
    assert found.median_m[:3].tolist() == pytest.approx([0.0, 0.03, 0.0], abs=1e-6)
    assert found.median_m[3].isnan()


def test_missing_depth_is_no_point():
    depth_m = torch.zeros(6, 8)
    pair = depth_pair(depth_m, depth_m, CAMERA, step=1)
    found = depth_consistency(pair, torch.eye(4)[None])
    assert found.agreeing.tolist() == found.score.tolist() == [0.0]
    assert found.median_m.isnan().all()


@pytest.mark.parametrize("step", [1, 2, 3, 4])
def test_thinned_depth_keeps_its_rays(generator, step):
    depth_m = torch.rand(6, 8, generator=generator) + 1
    camera, small = thinned(CAMERA, depth_m, step)
    first = (step - 1) // 2
    assert (camera.height, camera.width) == tuple(small.shape)
    expected = depth_to_points(CAMERA, depth_m)[first::step, first::step]
    assert torch.allclose(depth_to_points(camera, small), expected, atol=1e-6)


def test_relative_poses(generator):
    T = se3.exp(torch.randn(2, 6, generator=generator, dtype=torch.float64))
    relative = relative_poses(T[:1], T[1:])[0]
    assert torch.allclose(T[1] @ relative, T[0])
