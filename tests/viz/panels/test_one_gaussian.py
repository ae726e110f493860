"""The drawings of the chapter on splatting: one Gaussian, tiles, colour balls, and their panels."""

import numpy as np
import pytest
import torch

from gsfusion_nb.geometry import quaternion
from gsfusion_nb.render import project_gaussians, tile_intersections
from gsfusion_nb.render.constants import SCREEN_BLUR_PX2
from gsfusion_nb.types import Camera
from gsfusion_nb.viz.panels.one_gaussian import (
    gaussian_handles,
    gaussian_row,
    one_gaussian_panel,
    orientation_from_angles,
    projection_picture,
)
from gsfusion_nb.viz.panels.sh_ball import sh_ball, sh_ball_panel
from gsfusion_nb.viz.panels.tiles import tile_picture

CAMERA = Camera(
    width=80,
    height=60,
    fx=52.0,
    fy=52.0,
    cx=40.0,
    cy=30.0,
)
EYE = torch.eye(4)


def ball(z=2.0, scale=0.1):
    return gaussian_row(
        torch.tensor([0.0, 0.0, z]),
        torch.full((3,), scale),
        orientation_from_angles(0, 0),
    )


def test_turns_are_about_the_cameras_axes():
    x = torch.tensor([1.0, 0.0, 0.0])
    torch.testing.assert_close(
        quaternion.to_matrix(orientation_from_angles(90, 0)) @ x,
        torch.tensor([0.0, 1.0, 0.0]),
        atol=1e-6,
        rtol=0,
    )
    torch.testing.assert_close(
        quaternion.to_matrix(orientation_from_angles(0, 90)) @ x,
        torch.tensor([0.0, 0.0, -1.0]),
        atol=1e-6,
        rtol=0,
    )


def test_points_and_ellipses_are_drawn_and_agree_for_a_small_one():
    image, _ = projection_picture(ball(scale=0.2), CAMERA, zoom=6)
    orange = (np.abs(image.astype(int) - (255, 150, 40)).max(2) < 60).nonzero()
    white = (np.abs(image.astype(int) - 255).max(2) < 60).nonzero()
    assert len(orange[0]) > 300
    assert len(white[0]) > 100
    centre = [a.mean() for a in orange]
    assert np.abs(np.array(centre) - [180, 240]).max() < 6
    # of a 2D Gaussian, 1 - exp(-2) = 86 % lies within two standard deviations
    radius = np.hypot(orange[0] - 180, orange[1] - 240)
    outer = np.hypot(white[0] - 180, white[1] - 240).max()
    assert 0.78 < (radius < outer).mean() < 0.93


def test_degree_one_along_z_is_brightest_for_a_camera_that_looks_along_z():
    sh = torch.zeros(4, 3)
    sh[2] = 0.5
    image = sh_ball(sh, 61)
    assert image[30, 30, 0] > image[30, 50, 0] > 127


def test_the_longest_list_is_yellow(generator):
    params = ball(scale=0.02)
    p = project_gaussians(params, CAMERA, EYE)
    picture = tile_picture(
        torch.zeros(60, 80, 3),
        tile_intersections(p, CAMERA),
        scale=2,
    )
    assert picture.shape == (120, 160, 3)
    middle = picture[58, 78].astype(int)
    corner = picture[4, 4].astype(int)
    assert middle[0] > 120  # viridis ends in yellow
    assert middle[1] > 120
    assert corner[2] > corner[1]  # and begins in violet


@pytest.mark.parametrize(
    "make", [lambda: one_gaussian_panel(CAMERA), sh_ball_panel], ids=["one", "ball"]
)
def test_every_control_changes_the_picture(make):
    panel = make()
    start = panel.values
    for name, value in start.items():
        before = panel.picture().copy()
        panel.set(**{name: value + (0.3 if isinstance(value, float) else 5)})
        after = panel.picture()
        assert after.shape != before.shape or (after != before).any(), name
        panel.set(**start)


def test_the_gaussian_is_dragged_by_its_middle_and_by_the_ends_of_its_axes():
    panel = one_gaussian_panel(CAMERA, zoom=6).set(x_m=0.1, z_m=1.5, long_m=0.3, turn_deg=30)
    splat = projection_picture(_row_of(panel.values), CAMERA)[1].projection
    handles = gaussian_handles(panel.values, CAMERA, 6)
    assert handles["middle"] == pytest.approx((6 * splat.uv[0]).tolist(), abs=1e-3)
    A, B, C = splat.conic[0].tolist()
    cov = torch.tensor([[A, B], [B, C]]).double().inverse() - SCREEN_BLUR_PX2 * torch.eye(2)
    ends = [(np.array(handles[k]) - handles["middle"]) / 6 for k in ("long", "thick")]
    thin = cov - torch.tensor(sum(np.outer(e, e) for e in ends))  # only the thin third axis is left
    assert float(thin.abs().max()) < 1.0
    panel.drag(
        handles["middle"],
        (handles["middle"][0] + 6 * 52 * 0.2 / 1.5, handles["middle"][1]),
    )
    assert panel.values["x_m"] == pytest.approx(0.3)
    u, v = gaussian_handles(panel.set(lean_deg=20).values, CAMERA, 6)["long"]
    panel.drag((u, v), (u + 12, v + 40))
    after = gaussian_handles(panel.values, CAMERA, 6)["long"]
    # the handle stays under the pointer, up to a slider step
    assert after == pytest.approx((u + 12, v + 40), abs=3.5)
    thick = panel.values["thick_m"]
    (u, v), (mid_u, mid_v) = (
        gaussian_handles(panel.values, CAMERA, 6)[k] for k in ("thick", "middle")
    )
    panel.drag((u, v), (2 * u - mid_u, 2 * v - mid_v))
    assert panel.values["thick_m"] == pytest.approx(2 * thick, abs=0.003)


def _row_of(values):
    xyz = torch.tensor([values["x_m"], values["y_m"], values["z_m"]])
    scale = torch.tensor([values["long_m"], values["thick_m"], 0.02])
    return gaussian_row(xyz, scale, orientation_from_angles(values["turn_deg"], values["lean_deg"]))
