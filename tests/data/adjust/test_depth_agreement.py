"""Points of one depth image seen from another."""

import dataclasses

import pytest
import torch

from gsfusion_nb.data import folder
from gsfusion_nb.data.adjust.depth_agreement import (
    depth_agreement,
    depth_consistency,
    sparse_points,
    thinned,
)
from gsfusion_nb.geometry import depth_to_points
from gsfusion_nb.types import Camera


def test_agreement_of_exact_data(tmp_path, box):
    seq = folder(box.folder(tmp_path))
    agreement = depth_agreement(seq[0], seq[1], step=1)
    assert agreement.median_m < 0.01  # the lookup takes the nearest of 64x48 pixels
    assert agreement.agreeing > 0.9
    same = depth_agreement(seq[0], seq[0], step=1)
    assert same.median_m < 1e-6
    assert same.overlap == same.agreeing == 1.0
    away = dataclasses.replace(
        seq[1],
        T_WC=torch.diag(torch.tensor([-1.0, 1, -1, 1])),
    )
    assert depth_agreement(seq[0], away).overlap == 0.0


CAMERA = Camera(
    width=8,
    height=6,
    fx=8.0,
    fy=8.0,
    cx=4.0,
    cy=3.0,
)


def test_a_wall_by_hand():
    wall = torch.full((6, 8), 2.0)
    xyz_a = sparse_points(CAMERA, wall, 1)
    assert xyz_a.shape == (48, 3)
    still, nearer, aside, behind = torch.eye(4).repeat(4, 1, 1)
    nearer[2, 3] = -0.03  # 1.5 % of 2 m: half of what counts as agreeing
    aside[0, 3] = 1.0  # a pixel is 0.25 m wide there: four of eight columns leave
    behind[2, 3] = -3.0
    found = depth_consistency(
        xyz_a,
        wall,
        CAMERA,
        torch.stack([still, nearer, aside, behind]),
    )
    assert found.agreeing.tolist() == [1.0, 1.0, 0.5, 0.0]
    assert found.overlap.tolist() == [1.0, 1.0, 0.5, 0.0]
    assert found.score.tolist() == pytest.approx([1.0, 0.5, 0.5, 0.0], abs=1e-5)
    assert found.median_m[:3].tolist() == pytest.approx([0.0, 0.03, 0.0], abs=1e-6)
    assert found.median_m[3].isnan()


def test_missing_depth_is_no_point():
    depth_m = torch.zeros(6, 8)
    found = depth_consistency(
        sparse_points(CAMERA, depth_m, 1), depth_m, CAMERA, torch.eye(4)[None]
    )
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
