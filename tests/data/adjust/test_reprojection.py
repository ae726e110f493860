"""Points moved from frame to frame: closed forms on planes, and what is not compared."""

import numpy as np
import pytest
import torch

from gsfusion_nb.data.adjust.reprojection import (
    gain_stops,
    greys_at,
    is_usable_grey,
    reproject_depth,
)
from gsfusion_nb.geometry import pixel_grid
from gsfusion_nb.types import Camera

CAMERA = Camera(
    width=32,
    height=24,
    fx=30.0,
    fy=30.0,
    cx=16.0,
    cy=12.0,
)


def moved(x=0.0, y=0.0, z=0.0):
    T = torch.eye(4)
    T[:3, 3] = torch.tensor([x, y, z])
    return T[None]


def of_plane(T_ba, *, slope=0.0, is_ray=False):
    """The plane z = 2 + slope * x of the first camera, seen by both."""
    uv = pixel_grid(CAMERA)[4:20, 4:28].reshape(1, -1, 2)
    ray_x = (pixel_grid(CAMERA)[..., 0] - CAMERA.cx) / CAMERA.fx
    ray_y = (pixel_grid(CAMERA)[..., 1] - CAMERA.cy) / CAMERA.fy
    x, _, z = T_ba[0, :3, 3].tolist()
    first = 2 / (1 - slope * ray_x)
    second = (2 + z - slope * x) / (1 - slope * ray_x)
    length = (1 + ray_x**2 + ray_y**2).sqrt() if is_ray else torch.ones_like(ray_x)
    u, v = uv[0].long().unbind(-1)
    return reproject_depth(
        CAMERA,
        uv,
        (first * length)[v, u][None],
        (second * length)[None],
        T_ba,
        is_ray=is_ray,
    )


@pytest.mark.parametrize("slope", [0.0, 0.4])
@pytest.mark.parametrize(
    "shift",
    [(0.0, 0.0, 0.0), (0.05, 0.0, 0.0), (0.03, -0.04, 0.1)],
)
def test_a_plane_agrees_exactly(slope, shift):
    found = of_plane(moved(*shift), slope=slope)
    assert found.known.all()
    assert found.residual.abs().max() < 1e-5


def test_pixels_move_by_focal_length_times_step_over_depth():
    found = of_plane(moved(x=0.2))
    assert torch.allclose(
        found.uv_b[..., 0] - pixel_grid(CAMERA)[4:20, 4:28, 0].reshape(1, -1),
        torch.tensor(3.0),
    )


def test_the_length_of_the_ray_is_no_depth():
    assert of_plane(moved(x=0.1), is_ray=True).residual.abs().max() < 1e-3
    uv = pixel_grid(CAMERA)[12, 16][None, None]
    found = reproject_depth(
        CAMERA,
        uv,
        torch.tensor([[2.0]]),
        torch.full((1, 24, 32), 2.5),
        moved(),
    )
    assert float(found.residual) == pytest.approx(-0.2)


def test_what_is_not_compared():
    uv = torch.tensor([[16.5, 12.5]]).expand(1, 1, 2)
    wall, hole, edge = torch.full((3, 24, 32), 2.0)
    hole[12, 17] = 0.0
    edge[:, 17:] = 3.0
    uv_between = uv + 0.2
    cases = {
        "no depth": (uv, torch.zeros(1, 1), wall, moved()),
        "behind": (uv, torch.full((1, 1), 2.0), wall, moved(z=-3.0)),
        "outside": (uv, torch.full((1, 1), 2.0), wall, moved(x=5.0)),
        "beside a hole": (uv_between, torch.full((1, 1), 2.0), hole, moved()),
        "between two surfaces": (uv_between, torch.full((1, 1), 2.0), edge, moved()),
    }
    for name, (at, depth_a, depth_b, T_ba) in cases.items():
        found = reproject_depth(CAMERA, at, depth_a, depth_b[None], T_ba)
        assert not found.known.any(), name
        assert float(found.residual) == 0.0, name


def test_brightness_of_the_same_points():
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20
    at = torch.tensor([[1.0, 1.0], [7.9, 5.9], [-3.0, 100.0]])
    assert greys_at(grey, at, 8).tolist() == [0.0, 220.0, 160.0]
    a = np.array([10.0, 40.0, 50.0, 60.0])
    b = np.array([20.0, 80.0, 100.0, 250.0])
    assert is_usable_grey(a, b).tolist() == [False, True, True, False]
    assert gain_stops(a[1:3], b[1:3]) == 1.0
