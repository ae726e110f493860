"""Depth of a mesh against closed forms and against the room's own exact raycast."""

import pytest
import torch

from gsfusion_nb.data.room import render_room, room, room_mesh
from gsfusion_nb.geometry import pixel_grid, rays, se3
from gsfusion_nb.recordings.convert.scannetpp_scene import mesh_depth
from gsfusion_nb.types import Camera

CAMERA = Camera(width=61, height=47, fx=40.0, fy=42.0, cx=29.3, cy=24.1)
EYE = torch.eye(4)


def grid(n, z):
    """A square plate of n x n quads at depth ``z(x, y)``, 4 m wide."""
    s = torch.linspace(-2, 2, n + 1)
    y, x = torch.meshgrid(s, s, indexing="ij")
    vertices = torch.stack([x, y, z(x, y)], -1).reshape(-1, 3)
    i = torch.arange((n + 1) * (n + 1)).reshape(n + 1, n + 1)
    a, b, c, d = i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]
    faces = torch.stack([a, b, c, b, d, c], -1).reshape(-1, 3)
    return vertices, faces


@pytest.mark.parametrize("n", [1, 7, 60])
def test_plates(n):
    vertices, faces = grid(n, lambda x, y: 2 + 0.3 * x - 0.2 * y)
    depth_m = mesh_depth(vertices, faces, CAMERA, EYE)
    r = rays(CAMERA, pixel_grid(CAMERA))
    expected = 2 / (1 - 0.3 * r[..., 0] + 0.2 * r[..., 1])
    inside = (expected[..., None] * r[..., :2]).abs().amax(-1) < 2 - 1e-4
    outside = (expected[..., None] * r[..., :2]).abs().amax(-1) > 2 + 1e-4
    assert 0.5 < float(inside.float().mean()) < 1
    torch.testing.assert_close(depth_m[inside], expected[inside], atol=2e-6, rtol=0)  # no gap at any edge
    assert not depth_m[outside].any()


def test_a_triangle_that_reaches_behind_the_camera():
    """A floor 1 m below, from 50 m behind to 50 m ahead: z = fy / (v - cy)."""
    vertices = torch.tensor([[-90.0, 1.0, -50.0], [90.0, 1.0, -50.0], [0.0, 1.0, 50.0]])
    depth_m = mesh_depth(vertices, torch.tensor([[0, 1, 2]]), CAMERA, EYE)
    v = torch.arange(47) + 0.5
    below = v > CAMERA.cy + 1
    torch.testing.assert_close(depth_m[below, 29], CAMERA.fy / (v[below] - CAMERA.cy), atol=1e-4, rtol=1e-5)
    assert not depth_m[v < CAMERA.cy].any()


def test_pose_is_camera_to_world(generator):
    vertices, faces = grid(9, lambda x, y: 2 + 0.1 * x * y)
    T_WC = se3.exp(0.3 * torch.randn(6, generator=generator, dtype=torch.float64))
    moved = se3.apply(T_WC, vertices.double())
    here = mesh_depth(vertices, faces, CAMERA, EYE)
    there = mesh_depth(moved, faces, CAMERA, T_WC)
    torch.testing.assert_close(there, here, atol=1e-5, rtol=0)


def test_the_room():
    """Two ways to the same depth: first hits on exact surfaces, and the room's triangles."""
    camera = Camera(width=160, height=120, fx=104.0, fy=104.0, cx=80.0, cy=60.0)
    mesh = room_mesh(0.1)
    for i in (10, 90):
        T_WC = room(n_frames=200).pose(i)
        _, exact = render_room(camera, T_WC)
        depth_m = mesh_depth(mesh.vertices_W, mesh.faces, camera, T_WC)
        both = (exact > 0) & (depth_m > 0)
        assert float(both.float().mean()) > 0.995
        error = (depth_m - exact).abs()[both]
        assert float((error < 0.05).float().mean()) > 0.97  # curved things have flat triangles here, outlines differ
        assert float(error.median()) < 1e-6
