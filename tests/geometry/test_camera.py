import pytest
import torch

from gsfusion_nb.geometry import (
    backproject,
    depth_to_normals,
    depth_to_points,
    normals_at,
    pixel_grid,
    project,
    rays,
)
from gsfusion_nb.types import Camera

CAMERA = Camera(
    width=5,
    height=3,
    fx=10.0,
    fy=20.0,
    cx=2.5,
    cy=1.5,
)


def test_pixel_centres_are_at_halves():
    grid = pixel_grid(CAMERA)
    assert grid.shape == (3, 5, 2)
    assert grid[0, 0].tolist() == [0.5, 0.5]
    assert grid[2, 4].tolist() == [4.5, 2.5]


def test_by_hand():
    torch.testing.assert_close(
        project(CAMERA, torch.tensor([[0.0, 0, 3]])),
        torch.tensor([[2.5, 1.5]]),
    )
    torch.testing.assert_close(
        project(CAMERA, torch.tensor([[0.2, 0.1, 2.0]])),
        torch.tensor([[3.5, 2.5]]),
    )
    torch.testing.assert_close(
        rays(CAMERA, torch.tensor([[3.5, 2.5]])),
        torch.tensor([[0.1, 0.05, 1.0]]),
    )


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


WIDE = Camera(
    width=17,
    height=13,
    fx=20.0,
    fy=18.0,
    cx=8.0,
    cy=6.9,
)


def plane_depth(normal, distance):
    """z-depth of the plane n . p = -distance (the camera is on the side the normal points to)."""
    return -distance / (rays(WIDE, pixel_grid(WIDE, dtype=torch.float64)) @ normal)


@pytest.mark.parametrize(
    "n",
    [(0.0, 0.0, -1.0), (0.2, -0.1, -1.0), (-0.3, 0.3, -0.8)],
)
def test_plane(n):
    normal = torch.nn.functional.normalize(torch.tensor(n, dtype=torch.float64), dim=0)
    found = depth_to_normals(WIDE, plane_depth(normal, 2.0), max_jump=0.5)
    torch.testing.assert_close(
        found[1:-1, 1:-1],
        normal.expand(11, 15, 3),
        atol=1e-12,
        rtol=0,
    )
    assert (found[0] == 0).all()
    assert (found[:, -1] == 0).all()


def test_missing_depth_and_edges_give_none():
    depth = torch.full((13, 17), 2.0)
    depth[6, 8] = 0
    depth[:, 12:] = 3.0
    known = depth_to_normals(WIDE, depth).norm(dim=-1) > 0
    for y, x in [(6, 8), (5, 8), (7, 8), (6, 7), (6, 9)]:
        assert not known[y, x]
    assert not known[:, 11:13].any()
    assert known[3, 3]
    assert known[6, 14]


def test_image_too_small():
    camera = Camera(
        width=2,
        height=9,
        fx=1.0,
        fy=1.0,
        cx=1.0,
        cy=1.0,
    )
    assert (depth_to_normals(camera, torch.ones(9, 2)) == 0).all()


def test_normals_of_some_pixels_are_those_of_the_picture(generator):
    depth = 1 + 0.03 * torch.rand(WIDE.height, WIDE.width, generator=generator)
    depth[3:6, 4:9] = 0.0
    depth[:, 12:] = 2.0
    row, column = (torch.arange(n) for n in depth.shape)
    row, column = (x.reshape(-1) for x in torch.meshgrid(row, column, indexing="ij"))
    found = normals_at(WIDE, depth, row, column).view(*depth.shape, 3)
    torch.testing.assert_close(found, depth_to_normals(WIDE, depth))
    assert bool(found.any())
