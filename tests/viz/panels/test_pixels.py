"""The stack and the mix of a pixel add up to the rendered pixel, and the microscopes show them."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gsfusion_nb.drawing.pictures import LABEL_PX
from gsfusion_nb.geometry.spherical_harmonics import rgb_to_sh_dc
from gsfusion_nb.render import SurfacePicture, render, render_over_base
from gsfusion_nb.render.constants import ALPHA_MAX
from gsfusion_nb.render.over_base import Base
from gsfusion_nb.types import Camera, GaussianParams
from gsfusion_nb.viz import MixMicroscope, PixelMicroscope
from gsfusion_nb.viz.panels.ellipses import outlines
from gsfusion_nb.viz.panels.pixel_blend import project_splats
from gsfusion_nb.viz.panels.pixel_stack import pixel_stack

CAMERA = Camera(
    width=40,
    height=30,
    fx=40.0,
    fy=40.0,
    cx=20.5,
    cy=15.5,
)
EYE = torch.eye(4)


def rows(z, opacity, rgb, scale=0.5):
    n = len(z)
    quat = torch.zeros(n, 4)
    quat[:, 0] = 1
    return GaussianParams(
        xyz_W=torch.tensor([[0.0, 0.0, float(d)] for d in z]),
        log_scale=torch.full((n, 3), math.log(scale)),
        quat=quat,
        opacity_logit=torch.tensor(opacity).logit(),
        sh=rgb_to_sh_dc(torch.tensor(rgb))[:, None],
    )


def random_map(n, generator, opacity=0.0):
    xyz = torch.rand(n, 3, generator=generator) * torch.tensor([3.0, 2.4, 3.0]) + torch.tensor(
        [-1.5, -1.2, 0.5]
    )
    return GaussianParams(
        xyz_W=xyz,
        log_scale=torch.randn(n, 3, generator=generator) * 0.4 - 2.3,
        quat=torch.randn(n, 4, generator=generator),
        opacity_logit=torch.randn(n, generator=generator) + opacity,
        sh=torch.randn(n, 4, 3, generator=generator) * 0.3,
    )


def test_two_gaussians_by_hand():
    """Red 0.8 at 2 m in front of green 0.5 at 3 m, looked at in the middle: w = 0.8 and 0.2 *
    0.5."""
    params = rows(
        (3.0, 2.0),
        (0.5, 0.8),
        ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)),
    )
    stack = pixel_stack(project_splats(params, CAMERA, EYE), 20, 15)
    assert stack.row.tolist() == [1, 0]
    torch.testing.assert_close(stack.alpha, torch.tensor([0.8, 0.5]))
    torch.testing.assert_close(stack.transmittance, torch.tensor([1.0, 0.2]))
    torch.testing.assert_close(stack.weight, torch.tensor([0.8, 0.1]))
    torch.testing.assert_close(
        stack.colour,
        torch.tensor([0.8, 0.1, 0.0]),
        atol=1e-6,
        rtol=0,
    )
    assert stack.light_left == pytest.approx(0.1)
    assert "2 Gaussians" in repr(stack)


def test_the_clamp_and_the_stop():
    """0.9999 is clamped to 0.99; the second would leave 1e-4 and is the last; a third gets
    nothing."""
    params = rows(
        (1.0, 2.0, 3.0),
        (0.9999, 0.98, 0.9999),
        ((1.0, 0.0, 0.0),) * 3,
    )
    stack = pixel_stack(project_splats(params, CAMERA, EYE), 20, 15)
    assert len(stack) == 2
    assert float(stack.alpha[0]) == pytest.approx(ALPHA_MAX)
    assert stack.light_left == pytest.approx(0.01 * 0.02, rel=1e-3)


@pytest.mark.parametrize("opacity", [0.0, 4.0], ids=["soft", "opaque"])
def test_every_pixel_adds_up_to_the_rendered_one(generator, opacity):
    params = random_map(300, generator, opacity)
    image = render(params, CAMERA, EYE)
    splats = project_splats(params, CAMERA, EYE)
    worst = 0.0
    for u, v in ((u, v) for u in range(0, 40, 3) for v in range(0, 30, 3)):
        stack = pixel_stack(splats, u, v)
        worst = max(
            worst,
            float((stack.colour - image.rgb[v, u]).abs().max()),
        )
        worst = max(
            worst,
            abs(1 - stack.light_left - float(image.alpha[v, u])),
        )
        assert image.first_index is not None
        assert (int(stack.row[0]) if len(stack) else -1) == int(image.first_index[v, u])
    assert worst < 2e-5


LARGE = Camera(
    width=320,
    height=240,
    fx=208.0,
    fy=208.0,
    cx=160.0,
    cy=120.0,
)
EYE = torch.eye(4)


@pytest.fixture
def params(generator):
    n = 5000
    xyz = torch.rand(n, 3, generator=generator) * torch.tensor([4.0, 3.0, 3.0]) + torch.tensor(
        [-2.0, -1.5, 1.0]
    )
    return GaussianParams(
        xyz_W=xyz,
        log_scale=torch.randn(n, 3, generator=generator) * 0.4 - 3.2,
        quat=torch.randn(n, 4, generator=generator),
        opacity_logit=torch.randn(n, generator=generator),
        sh=torch.randn(n, 1, 3, generator=generator),
    )


def test_the_microscope_shows_what_the_function_gives_at_the_clicked_pixel(params):
    microscope = PixelMicroscope(params, LARGE, EYE, pixel=(10, 10))
    before = microscope.picture()
    microscope.drag((100.4 * 1.25, LABEL_PX + 60.6 * 1.25))
    stack = microscope.stack
    expected = pixel_stack(project_splats(params, LARGE, EYE), 100, 60)
    assert torch.equal(stack.row, expected.row)
    assert (
        np.abs(stack.colour.clamp(0, 1).numpy() - microscope.rendered[60, 100] / 255).max() < 0.01
    )
    assert (microscope.picture() != before).any()
    assert microscope.caption.value.count("<tr") == min(len(stack), 14) + 2 + (len(stack) > 14)
    microscope.drag((600.0, 100.0))  # in the other picture
    assert (microscope.stack.u, microscope.stack.v) == (100, 60)
    with pytest.raises(ValueError, match="outside the picture"):
        pixel_stack(microscope.splats, -1, 0)


def test_outlines_are_one_standard_deviation(params):
    splats = project_splats(params, LARGE, EYE)
    rows = torch.tensor([3, 77])
    ring = torch.from_numpy(outlines(splats, rows)) - splats.projection.uv[rows].double()[:, None]
    A, B, C = (c[:, None] for c in splats.projection.conic[rows].double().unbind(-1))
    dx, dy = ring.unbind(-1)
    sigma = 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy
    torch.testing.assert_close(
        sigma,
        torch.full_like(sigma, 0.5),
        rtol=1e-4,
        atol=1e-4,
    )


MIDDLE = Camera(
    width=80,
    height=60,
    fx=60.0,
    fy=60.0,
    cx=40.0,
    cy=30.0,
)
EYE = torch.eye(4)


@pytest.fixture
def mapper(generator):
    """200 Gaussians around a wall at 2 m, of which the left edge is a hole; some of them are far
    behind it."""
    n = 200
    size = (MIDDLE.height, MIDDLE.width)
    xyz = torch.rand(n, 3, generator=generator) * torch.tensor([2.4, 1.8, 0.6]) + torch.tensor(
        [-1.2, -0.9, 1.8]
    )
    params = GaussianParams(
        xyz_W=xyz,
        log_scale=torch.full((n, 3), -2.0),
        quat=torch.randn(n, 4, generator=generator),
        opacity_logit=torch.randn(n, generator=generator),
        sh=torch.randn(n, 1, 3, generator=generator) * 0.3,
    )
    depth_m = torch.full(size, 2.0)
    weight = torch.ones(size)
    depth_m[:, :8] = 0.0
    weight[:, :8] = 0.0
    base = Base(
        rgb=torch.full((*size, 3), 0.4),
        depth_m=depth_m,
        weight=weight,
    )
    surface = SurfacePicture(base=base, depth_everywhere_m=depth_m, behind_m=0.1)
    output = render_over_base(params, MIDDLE, EYE, base, behind_m=0.1)[0]
    return SimpleNamespace(
        parts=SimpleNamespace(params_now=lambda: params),
        surface_picture=lambda *_: surface,
        render=lambda *_: output,
        output=output,
    )


def test_the_mean_is_the_rendered_pixel_in_any_order(mapper, generator):
    microscope = MixMicroscope(mapper, MIDDLE, EYE)
    hidden = 0
    for u, v in ((40, 30), (3, 20), (79, 59), (0, 0)):
        microscope.set(u=u, v=v)
        mix = microscope.stack
        torch.testing.assert_close(
            mix.colour,
            mapper.output.rgb[v, u],
            rtol=1e-5,
            atol=1e-5,
        )
        torch.testing.assert_close(
            mix.total,
            float(mapper.output.weight[v, u]),
            rtol=1e-5,
            atol=1e-5,
        )
        other = mix.shuffled(generator)
        torch.testing.assert_close(other.colour, mix.colour, rtol=1e-5, atol=1e-6)
        assert sorted(other.row.tolist()) == sorted(mix.row.tolist())
        assert torch.equal(mix.running[0], mix.base_rgb * (mix.base_weight > 0))
        hidden += mix.hidden
    assert hidden > 0


def test_another_pixel_shows_another_mix(mapper):
    microscope = MixMicroscope(mapper, MIDDLE, EYE, pixel=(10, 10))
    before = microscope.caption.value, microscope.picture()
    microscope.set(u=50, v=40)
    assert before[0] != microscope.caption.value
    assert (before[1] != microscope.picture()).any()
    assert "surface and" in microscope.image.alt
    assert "image/jpeg" in microscope._repr_mimebundle_()[0]
