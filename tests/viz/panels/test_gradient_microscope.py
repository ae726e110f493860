"""Gradients of one pixel and of one Gaussian: autograd, the renderer's own sum, and the widget
without a browser."""

import pytest
import torch

from gsfusion_nb.drawing.curves import rgb_of
from gsfusion_nb.drawing.pictures import LABEL_PX
from gsfusion_nb.geometry.spherical_harmonics import sh_to_rgb
from gsfusion_nb.optim import l1_vjp
from gsfusion_nb.render import composite, composite_vjp, tile_intersections
from gsfusion_nb.types import Camera, GaussianParams
from gsfusion_nb.viz import GradientMicroscope
from gsfusion_nb.viz.panels.gradient_microscope import (
    LESS,
    MORE,
    gaussian_gradient_picture,
    pixel_gradient_picture,
)
from gsfusion_nb.viz.panels.pixel_blend import project_splats
from gsfusion_nb.viz.panels.pixel_gradients import gaussian_gradient, pixel_gradient

CAMERA = Camera(
    width=32,
    height=24,
    fx=26.0,
    fy=26.0,
    cx=16.0,
    cy=12.0,
)
EYE = torch.eye(4)


def random_map(n, generator, opacity=0.0):
    return GaussianParams(
        xyz_W=torch.rand(n, 3, generator=generator) * torch.tensor([2.4, 1.8, 2.0])
        + torch.tensor([-1.2, -0.9, 1.0]),
        log_scale=torch.randn(n, 3, generator=generator) * 0.4 - 2.5,
        quat=torch.randn(n, 4, generator=generator),
        opacity_logit=torch.randn(n, generator=generator) + opacity,
        sh=torch.randn(n, 1, 3, generator=generator) * 0.5,
    )


@pytest.fixture(params=[0.0, 5.0], ids=["soft", "opaque"])
def scene(request, generator):
    """Splats, dL/d of a random image, and the renderer's own gradient."""
    params = random_map(120, generator, request.param)
    splats = project_splats(params, CAMERA, EYE)
    p = splats.projection
    rgb = sh_to_rgb(params.sh, params.xyz_W, EYE[:3, 3])
    out = composite(
        p.uv,
        p.conic,
        p.opacity,
        rgb,
        p.depth_m,
        tile_intersections(p, CAMERA),
        CAMERA,
    )
    v_rgb = l1_vjp(out.rgb, torch.rand(24, 32, 3, generator=generator))
    return splats, v_rgb, composite_vjp(out.saved, v_rgb)


def test_the_field_of_a_gaussian_sums_up_to_the_renderers_gradient(scene):
    splats, v_rgb, total = scene
    scale = float(total.uv.abs().max())
    seen = 0
    for row in range(0, 120, 7):
        try:
            field = gaussian_gradient(splats, v_rgb, row)
        except ValueError:
            continue
        assert field.stride == 1
        torch.testing.assert_close(
            field.v_uv.sum((0, 1)),
            total.uv[row],
            rtol=1e-3,
            atol=1e-5 * scale,
        )
        seen += 1
    assert seen > 10


def test_all_pixels_together_give_the_renderers_gradient(scene):
    splats, v_rgb, total = scene
    n = len(splats.rgb)
    uv = torch.zeros(n, 2)
    rgb = torch.zeros(n, 3)
    opacity = torch.zeros(n)
    for v in range(24):
        for u in range(32):
            g = pixel_gradient(splats, v_rgb, u, v)
            uv.index_add_(0, g.stack.row, g.v_uv)
            rgb.index_add_(0, g.stack.row, g.v_rgb)
            opacity.index_add_(0, g.stack.row, g.v_opacity)
    for mine, theirs in ((uv, total.uv), (rgb, total.rgb), (opacity, total.opacity)):
        torch.testing.assert_close(
            mine,
            theirs,
            rtol=1e-3,
            atol=1e-5 * float(theirs.abs().max()),
        )


def test_one_pixel_against_autograd(generator):
    splats = project_splats(random_map(40, generator), CAMERA, EYE)
    v_rgb = torch.randn(24, 32, 3, generator=generator)
    g = pixel_gradient(splats, v_rgb, 16, 12)
    alpha = g.stack.alpha.clone().requires_grad_()
    T = torch.cat([torch.ones(1), (1 - alpha).cumprod(0)[:-1]])
    ((alpha * T) @ g.stack.rgb @ v_rgb[12, 16]).backward()
    torch.testing.assert_close(g.v_alpha, alpha.grad, rtol=1e-4, atol=1e-5)


def one_dot():
    """A grey dot in the middle, which the pixels want white."""
    return GaussianParams(
        xyz_W=torch.tensor([[0.0, 0.0, 2.0]]),
        log_scale=torch.full((1, 3), -1.5),
        quat=torch.tensor([[1.0, 0, 0, 0]]),
        opacity_logit=torch.zeros(1),
        sh=torch.zeros(1, 1, 3),
    )


def test_blue_is_more_opaque_and_orange_less():
    splats = project_splats(one_dot(), CAMERA, EYE)
    image = torch.zeros(24, 32, 3)
    for sign, ink, other in ((-1.0, MORE, LESS), (1.0, LESS, MORE)):
        v_rgb = torch.full((24, 32, 3), sign)
        for picture in (
            pixel_gradient_picture(image, splats, pixel_gradient(splats, v_rgb, 17, 12)),
            gaussian_gradient_picture(image, splats, gaussian_gradient(splats, v_rgb, 0)),
        ):
            counts = [
                (abs(picture.astype(int) - rgb_of(c)).max(2) < 60).sum() for c in (ink, other)
            ]
            assert counts[0] > 50
            assert counts[0] > 5 * counts[1]


def test_a_click_and_the_choice_change_what_is_shown(generator):
    m = GradientMicroscope(
        random_map(400, generator),
        CAMERA,
        EYE,
        torch.rand(24, 32, 3, generator=generator),
    )
    first = m.picture(), m.caption.value
    m.drag((10.5 * 222 / 24, LABEL_PX + 12.5 * 222 / 24))
    second = m.picture(), m.caption.value
    assert "pixel (10, 12)" in second[1]
    m.set(pick="Gaussian")
    assert "sum over all pixels" in m.caption.value
    assert (first[0] != second[0]).any()
    assert (second[0] != m.picture()).any()
    assert m.of_pixel.stack.u == 10
