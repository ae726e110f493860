import pytest
import torch

from gsfusion_nb.geometry import backproject, depth_to_points, pixel_grid, project, rays
from gsfusion_nb.types import Camera

CAMERA = Camera(width=5, height=3, fx=10.0, fy=20.0, cx=2.5, cy=1.5)


def test_pixel_centres_are_at_halves():
    grid = pixel_grid(CAMERA)
    assert grid.shape == (3, 5, 2)
    assert grid[0, 0].tolist() == [0.5, 0.5]
    assert grid[2, 4].tolist() == [4.5, 2.5]


def test_by_hand():
    torch.testing.assert_close(project(CAMERA, torch.tensor([[0.0, 0, 3]])), torch.tensor([[2.5, 1.5]]))
    torch.testing.assert_close(project(CAMERA, torch.tensor([[0.2, 0.1, 2.0]])), torch.tensor([[3.5, 2.5]]))
    torch.testing.assert_close(rays(CAMERA, torch.tensor([[3.5, 2.5]])), torch.tensor([[0.1, 0.05, 1.0]]))


@pytest.mark.parametrize("batch", [(1,), (3, 1, 2), (0,)])
def test_project_undoes_backproject(generator, batch):
    uv = 5 * torch.rand(*batch, 2, generator=generator, dtype=torch.float64)
    depth = 0.3 + torch.rand(*batch, generator=generator, dtype=torch.float64)
    points = backproject(CAMERA, uv, depth)
    torch.testing.assert_close(points[..., 2], depth)
    torch.testing.assert_close(project(CAMERA, points), uv)


def test_missing_depth_is_the_origin():
    depth = torch.ones(3, 5)
    depth[1, 2] = 0
    points = depth_to_points(CAMERA, depth)
    assert points[1, 2].tolist() == [0, 0, 0]
    torch.testing.assert_close(project(CAMERA, points[0]), pixel_grid(CAMERA)[0])


def test_resized_keeps_the_view():
    big = CAMERA.resized(10, 6)
    point = torch.tensor([[0.13, -0.04, 1.7]])
    torch.testing.assert_close(project(big, point), 2 * project(CAMERA, point))
