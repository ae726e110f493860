"""The pixel microscope without a browser: choosing a pixel changes pictures, table and caption, fast enough."""

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.types import Camera, GaussianParams
from gsfusion_nb.viz import PixelMicroscope
from gsfusion_nb.viz.panels.pixel_stack import (
    outlines,
    pixel_stack,
    project_splats,
    resize_to_height,
    stack_picture,
    with_cross,
)

CAMERA = Camera(width=320, height=240, fx=208.0, fy=208.0, cx=160.0, cy=120.0)
EYE = torch.eye(4)


@pytest.fixture
def params(generator):
    n = 5000
    xyz = torch.rand(n, 3, generator=generator) * torch.tensor([4.0, 3.0, 3.0]) + torch.tensor([-2.0, -1.5, 1.0])
    return GaussianParams(
        xyz_W=xyz,
        log_scale=torch.randn(n, 3, generator=generator) * 0.4 - 3.2,
        quat=torch.randn(n, 4, generator=generator),
        opacity_logit=torch.randn(n, generator=generator),
        sh=torch.randn(n, 1, 3, generator=generator),
    )


def decoded(value):
    return np.asarray(cv2.imdecode(np.frombuffer(value, np.uint8), cv2.IMREAD_COLOR))[..., ::-1]


def test_a_click_shows_another_stack(params):
    microscope = PixelMicroscope(params, CAMERA, EYE)
    before = microscope.table.value, microscope.lens.value, microscope.graph.value
    microscope.clicks.pixel = (40, 200)  # what the front end does
    assert (microscope.stack.u, microscope.stack.v) == (40, 200)
    assert all(
        a != b
        for a, b in zip(before, (microscope.table.value, microscope.lens.value, microscope.graph.value), strict=True)
    )
    assert "pixel (40, 200)" in microscope.caption.value


def test_from_python_it_is_the_function(params):
    microscope = PixelMicroscope(params, CAMERA, EYE, pixel=(10, 10))
    stack = microscope.look_at(100, 60)
    expected = pixel_stack(project_splats(params, CAMERA, EYE), 100, 60)
    assert torch.equal(stack.row, expected.row)
    assert microscope.clicks.pixel == (100, 60)
    rendered = microscope.image[60, 100] / 255
    assert np.abs(stack.colour.clamp(0, 1).numpy() - rendered).max() < 0.01


def test_a_pixel_outside_is_refused_and_nothing_changes(params):
    microscope = PixelMicroscope(params, CAMERA, EYE, pixel=(10, 10))
    with pytest.raises(ValueError, match="outside the picture"):
        microscope.look_at(-1, 0)
    assert (microscope.stack.u, microscope.stack.v) == (10, 10)
    microscope.clicks.pixel = (999, -5)  # a front end may be mistaken
    assert (microscope.stack.u, microscope.stack.v) == (319, 0)


def test_bars_have_the_height_of_weight_and_the_strip_ends_in_the_colour(params):
    stack = pixel_stack(project_splats(params, CAMERA, EYE), 160, 120)
    image = stack_picture(stack, width=420, height=240, scale=2)
    assert image.shape == (480, 840, 3)
    end = image[(240 - 32) * 2, 840 - 24 - 3]
    expected = (stack.colour.clamp(0, 1).numpy() * 255).round()
    assert np.abs(end.astype(float) - expected).max() <= 2


def test_outlines_are_one_standard_deviation(params):
    splats = project_splats(params, CAMERA, EYE)
    rows = torch.tensor([3, 77])
    ring = torch.from_numpy(outlines(splats, rows)) - splats.projection.uv[rows].double()[:, None]
    A, B, C = (c[:, None] for c in splats.projection.conic[rows].double().unbind(-1))
    dx, dy = ring.unbind(-1)
    sigma = 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy
    torch.testing.assert_close(sigma, torch.full_like(sigma, 0.5), rtol=1e-4, atol=1e-4)


def test_the_cross_leaves_the_pixel_free():
    image = np.full((30, 40, 3), 90, np.uint8)
    picture = with_cross(image, 20, 15, 300)
    assert picture.shape == (300, 400, 3)
    assert picture[155, 205].tolist() == [90, 90, 90]
    assert picture[155, 205 + 9].tolist() == [255, 210, 0]
    assert resize_to_height(image, 15).shape == (15, 20, 3)
