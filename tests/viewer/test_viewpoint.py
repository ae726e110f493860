"""Orbit cameras: by hand first, then the properties every one of them has."""

import math

import pytest
import torch

from gsfusion_nb.checks import check_pose
from gsfusion_nb.geometry import camera, se3
from gsfusion_nb.types import Camera
from gsfusion_nb.viewer.viewpoint import extent, orbit_camera

CAMERA = Camera(
    width=320,
    height=240,
    fx=200.0,
    fy=200.0,
    cx=160.0,
    cy=120.0,
)


def pixel(T_WC, point):
    return camera.project(
        CAMERA,
        se3.apply(se3.inverse(T_WC), torch.tensor([point], dtype=torch.float32)),
    )[0]


def test_by_hand_with_z_up():
    T = orbit_camera((0, 0, 0), 0, 0, 2.0)
    assert T[:3, 3].tolist() == [2, 0, 0]
    # right = +y, down = -z, forward = -x
    expected = torch.tensor([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]])
    assert torch.allclose(T[:3, :3], expected, atol=1e-7)
    assert torch.allclose(
        orbit_camera((0, 0, 1), 90, 0, 2.0)[:3, 3],
        torch.tensor([0.0, 2, 1]),
        atol=1e-6,
    )
    assert torch.allclose(
        orbit_camera((0, 0, 0), 0, 30, 2.0)[2, 3],
        torch.tensor(1.0),
    )


@pytest.mark.parametrize(
    "up",
    [(0, 0, 1), (0, -1, 0), (0, 0, -2), (1, 2, 3)],
)
@pytest.mark.parametrize("elevation", [-90, -20, 0, 45, 90])
@pytest.mark.parametrize("azimuth", [-170, 0, 33])
def test_target_in_the_middle_and_the_picture_upright(up, elevation, azimuth):
    target = torch.tensor([0.3, -0.2, 1.0])
    T = orbit_camera(target, azimuth, elevation, 3.0, up)
    check_pose("T", T)
    assert torch.allclose(
        pixel(T, target.tolist()),
        torch.tensor([160.0, 120.0]),
        atol=1e-3,
    )
    assert (T[:3, 3] - target).norm() == pytest.approx(3.0, abs=1e-5)
    unit = torch.nn.functional.normalize(torch.tensor(up, dtype=torch.float32), dim=0)
    assert abs(float(T[:3, 0] @ unit)) < 1e-6  # the horizon is level
    if abs(elevation) < 90:
        u, v = pixel(T, (target + 0.1 * unit).tolist())
        assert u == pytest.approx(160.0, abs=1e-2)
        assert v < 120.0  # what is up is up in the picture


def test_impossible_orbits_are_refused():
    with pytest.raises(ValueError, match="distance_m must be >= 0, got -1"):
        orbit_camera((0, 0, 0), 0, 0, -1)
    with pytest.raises(ValueError, match="up_W must be a direction"):
        orbit_camera((0, 0, 0), 0, 0, 1, (0, 0, 0))


def test_extent_ignores_outliers():
    grid = torch.linspace(-1, 1, 11)
    points = torch.stack(torch.meshgrid(grid, grid, grid, indexing="ij"), -1).reshape(-1, 3)
    centre, radius = extent(torch.cat([points, torch.tensor([[1e6, 0.0, 0.0]])]))
    assert centre.abs().max() < 1e-3
    assert radius == pytest.approx(math.sqrt(3), rel=1e-3)
    assert extent(torch.zeros(0, 3))[1] == 1.0
