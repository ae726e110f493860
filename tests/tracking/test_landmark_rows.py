"""Rows of landmarks: their derivative, the pose that they give, and what wrong matches do to it."""

import numpy as np
import pytest
import torch

from gsfusion_nb.geometry import project, se3
from gsfusion_nb.tracking.landmark_rows import CAUCHY, LandmarkRows, landmark_pose, landmark_sums
from gsfusion_nb.types import Camera

CAMERA = Camera(width=320, height=240, fx=208.0, fy=210.0, cx=161.0, cy=119.0)
T_TRUE = se3.exp(torch.tensor([0.4, -0.3, 0.2, 0.3, -0.8, 0.2], dtype=torch.float64))


@pytest.fixture
def rows(generator):
    """40 exact landmarks; every fourth without depth."""
    xyz_C = torch.rand(40, 3, generator=generator, dtype=torch.float64) * 2 + torch.tensor([-1.0, -1.0, 1.5])
    inverse = 1 / xyz_C[:, 2] * (torch.arange(40) % 4 > 0)
    return LandmarkRows(
        camera=CAMERA,
        xyz_W=se3.apply(T_TRUE, xyz_C).numpy(),
        uv=project(CAMERA, xyz_C).numpy(),
        inverse_depth=inverse.numpy(),
        sigma_px=np.full(40, 1.5),
    )


def test_the_gradient_is_that_of_the_robust_errors(rows):
    """b = 1/2 d/dxi of c^2 ln(1 + |e|^2 / c^2), for a twist about any point."""
    T_WC = T_TRUE @ se3.exp(torch.tensor([0.02, 0.01, -0.03, 0.01, 0.02, -0.01], dtype=torch.float64))
    centre = torch.tensor([0.3, 0.1, -0.2], dtype=torch.float64)

    def cost(xi):
        moved = se3.translate(se3.exp(xi) @ se3.translate(T_WC, -centre), centre)
        e, _, _ = rows.errors(moved)
        return float((CAUCHY**2 * np.log1p((e * e).sum(1) / CAUCHY**2)).sum())

    sums = landmark_sums(rows, T_WC, centre)
    steps = 1e-6 * torch.eye(6, dtype=torch.float64)
    slope = torch.tensor([(cost(s) - cost(-s)) / 2e-6 for s in steps], dtype=torch.float64)
    torch.testing.assert_close(2 * sums.b, slope, rtol=1e-5, atol=1e-3)
    assert float(torch.linalg.eigvalsh(sums.H)[0]) > 0


def test_the_pose_survives_wrong_matches(rows, generator, assert_pose):
    uv = rows.uv.copy()
    uv[:12] += 15 * torch.randn(12, 2, generator=generator).numpy()
    start = T_TRUE @ se3.exp(torch.tensor([0.03, -0.02, 0.04, 0.02, 0.03, -0.03], dtype=torch.float64))
    spoiled = LandmarkRows(
        camera=CAMERA, xyz_W=rows.xyz_W, uv=uv, inverse_depth=rows.inverse_depth, sigma_px=rows.sigma_px
    )
    found = landmark_pose(spoiled, start)
    assert_pose(found, T_TRUE, 4e-3, 0.2)
    assert spoiled.agree(found)[12:].all()
    assert spoiled.agree(found)[:12].mean() < 0.3


def test_points_behind_the_camera_give_nothing(rows):
    away = T_TRUE @ se3.exp(torch.tensor([0, 0, 10.0, 0, 0, 0], dtype=torch.float64))
    sums = landmark_sums(rows, away)
    assert not sums.H.any()
    assert not sums.b.any()
    assert sums.cost == 0
    assert not rows.agree(away).any()
