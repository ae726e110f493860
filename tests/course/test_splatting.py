"""Chapter 4's checkers agree with the library, and say what a person needs to hear."""

import torch

from gsfusion_nb.course import check, splatting
from gsfusion_nb.course.tiles import _tiles_touched
from gsfusion_nb.geometry import quaternion
from gsfusion_nb.render import project_gaussians, tile_intersections
from gsfusion_nb.types import Camera
from gsfusion_nb.viz.panels.one_gaussian import gaussian_row, orientation_from_angles

CAMERA = Camera(
    width=80,
    height=60,
    fx=52.0,
    fy=60.0,
    cx=40.0,
    cy=30.0,
)


def one(x=0.2):
    return gaussian_row(
        torch.tensor([x, -0.1, 1.5]),
        torch.tensor([0.3, 0.1, 0.02]),
        orientation_from_angles(30, 40),
        opacity=0.7,
    )


def test_the_covariance_is_the_librarys():
    params = one()
    R = quaternion.to_matrix(params.quat[0])
    S2 = torch.diag(params.log_scale[0].exp() ** 2)
    cov = splatting._covariance_2d(
        params.xyz_W[0],
        R @ S2 @ R.T,
        CAMERA.fx,
        CAMERA.fy,
    )
    A, B, C = project_gaussians(params, CAMERA, torch.eye(4)).conic[0]
    torch.testing.assert_close(
        cov.inverse(),
        torch.stack([A, B, B, C]).view(2, 2),
        rtol=1e-4,
        atol=1e-6,
    )


def test_the_tiles_contain_the_librarys():
    p = project_gaussians(one(), CAMERA, torch.eye(4))
    tiles = tile_intersections(p, CAMERA)
    u, v = p.uv[0].tolist()
    x0, x1, y0, y1 = _tiles_touched(
        u,
        v,
        float(p.extent_px.max()),
        80,
        60,
        tiles.tile_px,
    )
    listed = {
        (int(t) % tiles.tiles_x, int(t) // tiles.tiles_x) for t in tiles.offset.diff().nonzero()
    }
    assert listed <= {(x, y) for x in range(x0, x1) for y in range(y0, y1)}


def test_a_forgotten_second_result_is_named():
    verdict = check.composite_pixel(lambda alpha, rgb: rgb.sum(0))
    assert "it returns colour, light left" in repr(verdict)
