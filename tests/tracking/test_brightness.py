"""The brightness error that joins ICP: its derivative, its exposure, and what it finds where depth
slides."""

import dataclasses

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TrackingConfig
from gsfusion_nb.geometry import project, se3
from gsfusion_nb.tracking import (
    BrightnessSystem,
    Pictures,
    align,
    brightness_levels,
    brightness_rows,
    brightness_system,
    depth_pyramid,
    picture_of,
)

from .conftest import CAMERA

EXACT = TrackingConfig(
    even_to_m=None,
    pyramid=(4, 2, 1),
    iterations=(10, 10, 10),
)
NEARBY = torch.tensor([0.02, 0.03, -0.04, 0.01, 0.01, 0.02]).double()


def test_the_derivative_is_that_of_a_linear_picture(generator):
    R = se3.exp(torch.tensor([0, 0, 0, 0.3, -0.2, 0.1]).double())[:3, :3]
    xyz_S = torch.rand(7, 3, generator=generator).double() + torch.tensor([0.0, 0.0, 1.0])
    xyz = xyz_S @ R.T
    slope = torch.tensor([0.03, -0.05]).double()

    def brightness(xi):
        return project(CAMERA, se3.apply(se3.exp(xi), xyz) @ R) @ slope

    expected = torch.autograd.functional.jacobian(brightness, torch.zeros(6).double())
    torch.testing.assert_close(brightness_rows(xyz, xyz_S, slope.expand(7, 2), CAMERA, R), expected)


def test_the_best_exposure_is_put_in(generator):
    m = torch.randn(40, 7, generator=generator).double()
    J = m[:, :6]
    r = m[:, 6]
    w = torch.rand(40, generator=generator).double()
    rows = torch.cat([m, torch.ones(40, 1).double()], dim=1)
    system = BrightnessSystem(gram=rows.T @ (w[:, None] * rows), n=40)
    assert system.offset == pytest.approx(float((w * r).sum() / w.sum()))
    assert system.rms == pytest.approx(
        float(((w * (r - system.offset) ** 2).sum() / w.sum()).sqrt())
    )
    H, b = system.normal_equations()
    with_exposure = torch.cat([J, -torch.ones(40, 1).double()], dim=1)
    root = w.sqrt()[:, None]
    expected = torch.linalg.lstsq(root * with_exposure, -root * r[:, None]).solution[:6, 0]
    torch.testing.assert_close(torch.linalg.solve(H, -b), expected)


@pytest.mark.parametrize("backend", ["reference", "auto"])
def test_a_painted_wall_is_found_although_its_depth_slides(plane_scene, assert_pose, backend):
    """In another exposure, too. Depth alone leaves the two translations along the wall and the roll
    to the start."""
    scene = plane_scene("wall", painted=True)
    T_WC = se3.exp(torch.tensor([0.3, -0.2, 0.1, 0.05, 0.1, -0.05]).double())
    frame = scene.frame(T_WC)
    frame = dataclasses.replace(frame, rgb=frame.rgb + 0.1)
    surface = scene(CAMERA, se3.exp(0.5 * NEARBY) @ T_WC)
    levels = depth_pyramid(frame.depth_m, CAMERA, EXACT.pyramid)
    pictures = Pictures.of(brightness_levels(frame.rgb, EXACT.pyramid), surface)
    assert pictures is not None
    with use_backend(backend):
        found = align(levels, surface, se3.exp(NEARBY) @ T_WC, EXACT, pictures=pictures)
        alone = align(levels, surface, se3.exp(NEARBY) @ T_WC, EXACT)
    assert (alone.degenerate, found.degenerate) == (3, 0)
    assert_pose(found.T_WC, T_WC, 1e-3, 0.03)
    assert pictures.offset == pytest.approx(-0.1, abs=0.01)
    assert float((alone.T_WC - T_WC)[:3, 3].norm()) > 0.02


def test_pixels_without_a_known_neighbour_or_behind_the_surface_say_nothing(plane_scene):
    scene = plane_scene("wall", painted=True)
    T_WC = torch.eye(4).double()
    frame = scene.frame(T_WC)
    surface = scene(CAMERA, T_WC)
    level = depth_pyramid(frame.depth_m, CAMERA, (1,))[0]
    brightness = frame.rgb.mean(-1)

    def n(surface, limit_m=0.05, level=level):
        picture = picture_of(surface, surface.rgb, 1)
        return brightness_system(level, brightness, T_WC, picture, max_distance_m=limit_m).n

    hole = dataclasses.replace(surface, depth_m=surface.depth_m.clone())
    hole.depth_m[50:60, 50:60] = 0.0
    everything = n(surface)
    edge = 2 * (CAMERA.width + CAMERA.height) - 4
    assert everything == pytest.approx(CAMERA.width * CAMERA.height - edge, rel=0.01)
    assert everything - n(hole) == pytest.approx(100 + 40, abs=3)
    behind = dataclasses.replace(surface, depth_m=surface.depth_m - 0.1)
    assert (n(behind), n(behind, 0.2)) == (0, everything)
    grey = dataclasses.replace(surface, rgb=torch.full_like(surface.rgb, 0.5))
    assert n(grey) == 0
    assert Pictures.of({1: brightness}, dataclasses.replace(surface, rgb=None)) is None


def test_a_small_picture_has_the_depth_of_the_middle_of_each_block(plane_scene):
    scene = plane_scene("wall", painted=True)
    surface = scene(CAMERA, torch.eye(4).double())
    height, width = surface.depth_m.shape
    number = torch.arange(height * width).view(height, width)
    numbered = dataclasses.replace(surface, depth_m=1 + number.to(surface.depth_m))
    for factor in (2, 4):
        picture = picture_of(numbered, surface.rgb, factor)
        middle = factor // 2
        assert picture.depth_m[0, 0] == 1 + number[middle, middle]
        assert picture.depth_m[1, 1] == 1 + number[factor + middle, factor + middle]
