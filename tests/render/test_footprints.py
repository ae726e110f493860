"""Visibility and size in the image, by hand and against the projection of every row."""

import math

import torch

from gsfusion_nb.render import footprints, project_gaussians
from gsfusion_nb.types import Camera, GaussianParams

CAMERA = Camera(width=40, height=30, fx=100.0, fy=100.0, cx=20.0, cy=15.0)


def gaussians(xyz: list[list[float]], scale: float = 0.01, opacity: float = 0.5) -> GaussianParams:
    n = len(xyz)
    return GaussianParams(
        xyz_W=torch.tensor(xyz).reshape(n, 3),
        log_scale=torch.full((n, 3), math.log(scale)),
        quat=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4).clone(),
        opacity_logit=torch.full((n,), opacity).logit(),
        sh=torch.zeros(n, 1, 3),
    )


def test_size_of_a_round_gaussian_by_hand():
    """1 cm at 2 m and fx 100: variance 0.25 + 0.3 px^2; alpha falls to 1/255 at sqrt(2 ln(255 o)) deviations."""
    seen = footprints(gaussians([[0.0, 0.0, 2.0]]), CAMERA, torch.eye(4))
    assert seen.visible.tolist() == [True]
    torch.testing.assert_close(seen.radius_px, torch.tensor([math.sqrt(2 * math.log(127.5) * 0.55)]))


def test_what_is_seen_by_hand():
    """In the middle; beside the image but reaching into it (centre 22 px right of the middle, 2.3 px reach beyond
    1.5); beside it; behind the camera; nearer than the near plane."""
    xyz = [[0.0, 0.0, 2.0], [0.43, 0.0, 2.0], [0.6, 0.0, 2.0], [0.0, 0.0, -2.0], [0.0, 0.0, 0.001]]
    seen = footprints(gaussians(xyz), CAMERA, torch.eye(4))
    assert seen.visible.tolist() == [True, True, False, False, False]
    assert (seen.radius_px > 0).tolist() == seen.visible.tolist()
    hidden = footprints(gaussians(xyz[:1], opacity=0.003), CAMERA, torch.eye(4))
    assert hidden.visible.tolist() == [False]


def test_same_as_the_projection_of_every_row(generator):
    params = gaussians((6 * torch.rand(500, 3, generator=generator) - 3).tolist(), scale=0.2)
    params.sh[7] = torch.nan
    params.log_scale[9] = torch.inf
    p = project_gaussians(params, CAMERA, torch.eye(4))
    size = torch.tensor([CAMERA.width, CAMERA.height])
    expected = p.visible & ((p.uv + p.extent_px > 0) & (p.uv - p.extent_px < size)).all(1)
    expected[7] = False
    seen = footprints(params, CAMERA, torch.eye(4))
    assert expected.sum() > 20
    assert torch.equal(seen.visible, expected)
    assert torch.equal(seen.radius_px[expected], p.extent_px[expected].amax(1))
    assert footprints(params[:0], CAMERA, torch.eye(4)).visible.shape == (0,)
