"""Depth of one camera in the image of another: a plane, whose depth there is known in closed
form."""

import math

import numpy as np
import pytest
import torch

from gsfusion_nb.data import SequenceError
from gsfusion_nb.data.depth_registration import register_depth, warp_depth
from gsfusion_nb.data.lens import CameraModel, Undistorter, same_proportions
from gsfusion_nb.geometry import pixel_grid, rays, se3
from gsfusion_nb.types import Camera

COLOUR = Camera(
    width=96,
    height=72,
    fx=70.0,
    fy=68.0,
    cx=47.3,
    cy=36.4,
)
BESIDE = se3.exp(torch.tensor([0.015, -0.002, 0.004, 0.01, -0.02, 0.015], dtype=torch.float64))
"""From a depth camera 15 mm beside to the colour camera."""
TURNED = torch.tensor(
    [[0.0, -1.0, 0.0, 0.01], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
    dtype=torch.float64,
)
"""The same for a sensor mounted on its side."""


def plane_depth(camera: Camera, normal: torch.Tensor, distance_m: float) -> torch.Tensor:
    """z-depth of the plane normal . P = distance, in the frame of ``camera``. [H, W]"""
    grid = rays(camera, pixel_grid(camera, dtype=torch.float64))
    return distance_m / (grid @ normal)


def wide(share: float) -> Camera:
    """A depth camera that sees more than ``COLOUR``, with a share of its resolution."""
    camera = COLOUR.resized(round(share * COLOUR.width), round(share * COLOUR.height))
    margin = 8
    return Camera(
        width=camera.width + 2 * margin,
        height=camera.height + 2 * margin,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx + margin,
        cy=camera.cy + margin,
    )


@pytest.mark.parametrize("share", [2.0, 1.0, 0.7, 0.5, 0.33, 0.12])
@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_a_plane_covers_the_whole_image_at_every_ratio_of_resolutions(share, tilt):
    normal = torch.tensor(
        [math.sin(tilt), 0.0, math.cos(tilt)],
        dtype=torch.float64,
    )
    truth = plane_depth(COLOUR, normal, 2.0)
    T_depth_colour = se3.inverse(BESIDE)
    normal_D = T_depth_colour[:3, :3] @ normal
    source = wide(share)
    depth_m = plane_depth(source, normal_D, float(2.0 + normal_D @ T_depth_colour[:3, 3]))
    found = register_depth(depth_m, source, COLOUR, BESIDE)
    assert float((found > 0).double().mean()) == 1.0
    # within half a footprint and half a pixel of the truth, along the plane's slope
    slope = torch.gradient(truth, dim=1)[0].abs()
    bound = slope * (0.75 / share + 1.0) + 0.02
    assert bool(((found - truth).abs() <= bound).all())


def test_a_lower_resolution_gives_blocks_and_interpolates_nothing():
    low = COLOUR.resized(32, 24)
    depth_m = 1.0 + torch.rand(
        24, 32, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    depth_m[5:9, 20:30] = 0.0
    found = register_depth(depth_m, low, COLOUR, torch.eye(4, dtype=torch.float64))
    assert torch.equal(found, depth_m.repeat_interleave(3, 0).repeat_interleave(3, 1))


def test_equal_cameras_change_nothing_and_a_far_surface_gives_way():
    depth_m = 1.0 + torch.rand(
        72,
        96,
        generator=torch.Generator().manual_seed(1),
    )
    depth_m[10:20, 30:50] = 0.0
    assert torch.equal(register_depth(depth_m, COLOUR, COLOUR, torch.eye(4)), depth_m)
    lower = COLOUR.resized(48, 36)
    nearest = warp_depth(depth_m, COLOUR, lower, BESIDE)
    found = register_depth(depth_m, COLOUR, lower, BESIDE)
    assert torch.equal(found > 0, nearest > 0)
    assert bool((found <= 1.05 * nearest + 1e-6).all())


@pytest.mark.parametrize("share", [4.0, 2.0])
def test_a_higher_resolution_does_not_draw_a_slope_nearer(share):
    """The nearest of several points in a pixel is on average too near; the most central one is
    not."""
    normal = torch.tensor([0.5, 0.1, 0.8], dtype=torch.float64)
    truth = plane_depth(COLOUR, normal, 2.0)
    T_depth_colour = se3.inverse(BESIDE)
    normal_D = T_depth_colour[:3, :3] @ normal
    source = wide(share)
    depth_m = plane_depth(source, normal_D, float(2.0 + normal_D @ T_depth_colour[:3, 3]))
    off = register_depth(depth_m, source, COLOUR, BESIDE) / truth - 1
    assert abs(float(off.mean())) < 2e-4
    nearest = warp_depth(depth_m, source, COLOUR, BESIDE)
    assert float((nearest / truth - 1)[nearest > 0].mean()) < -1e-3


def test_a_sensor_on_its_side_and_what_is_nearest():
    source = Camera(
        width=40,
        height=40,
        fx=20.0,
        fy=20.0,
        cx=20.0,
        cy=20.0,
    )
    far = torch.full((40, 40), 3.0, dtype=torch.float64)
    found = register_depth(far, source, COLOUR, TURNED)
    assert bool((found == 3.0).all())
    near = far.clone()
    near[18:22, 18:22] = 1.0
    found = register_depth(near, source, COLOUR, TURNED)
    block = (4 * 70 / 20, 4 * 68 / 20)  # pixels of colour that four of depth cover
    assert int((found == 1.0).sum()) == pytest.approx(block[0] * block[1], rel=0.1)
    assert set(found.unique().tolist()) == {1.0, 3.0}


def test_what_is_almost_beside_the_camera_stays_a_point():
    """A pixel whose outline reaches behind the other camera has no outline there."""
    source = Camera(
        width=1,
        height=1,
        fx=0.5,
        fy=0.5,
        cx=0.5,
        cy=0.5,
    )
    T = torch.tensor(
        [[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0.5], [0, 0, 0, 1]],
        dtype=torch.float64,
    )
    found = register_depth(
        torch.full((1, 1), 2.0, dtype=torch.float64),
        source,
        COLOUR.resized(4000, 40),
        T,
    )
    assert int((found > 0).sum()) <= 1
    assert not register_depth(
        torch.zeros(3, 3),
        source.resized(3, 3),
        COLOUR,
        T,
    ).any()


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [
        ((640, 480), (320, 240), True),
        ((1920, 1440), (256, 192), True),
        ((1296, 968), (320, 239), True),  # rounded
        ((1296, 968), (640, 480), False),
        ((320, 180), (160, 144), False),
        ((1280, 720), (848, 480), False),
        ((1280, 720), (424, 240), False),
        ((64, 48), (48, 64), False),
    ],
)
def test_same_proportions(first, second, same):
    assert same_proportions(first, second) == same_proportions(second, first) == same
    model = CameraModel(
        Camera(
            width=first[0],
            height=first[1],
            fx=50.0,
            fy=50.0,
            cx=30.0,
            cy=20.0,
        )
    )
    if same:
        width, height = second
        fitted = model.fitted(width, height, "an image").camera
        assert np.array_equal(fitted.K, model.camera.resized(width, height).K)
    else:
        with pytest.raises(SequenceError, match=r"an image is .* of other proportions"):
            model.fitted(second[0], second[1], "an image")


def test_a_depth_camera_in_the_place_of_the_colour_camera_needs_no_pose():
    low = COLOUR.resized(32, 24)
    lens = Undistorter(CameraModel(camera=COLOUR), depth_camera=low)
    depth_m = np.full((24, 32), 1.5, np.float32)
    found = lens.depth(depth_m)
    assert (found[1::3, 1::3] == 1.5).all()  # each pixel's middle
    assert np.count_nonzero(found) == depth_m.size
