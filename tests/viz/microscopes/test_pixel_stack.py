"""The stack of a pixel adds up to the rendered pixel; by hand for two Gaussians, then against the renderer."""

import math

import pytest
import torch

from gsfusion_nb.constants import ALPHA_MAX
from gsfusion_nb.geometry.spherical_harmonics import rgb_to_sh_dc
from gsfusion_nb.render import render
from gsfusion_nb.types import Camera, GaussianParams
from gsfusion_nb.viz.panels.pixel_stack import blend_at, pixel_stack, project_splats, stack_table

CAMERA = Camera(width=40, height=30, fx=40.0, fy=40.0, cx=20.5, cy=15.5)
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
    xyz = torch.rand(n, 3, generator=generator) * torch.tensor([3.0, 2.4, 3.0]) + torch.tensor([-1.5, -1.2, 0.5])
    return GaussianParams(
        xyz_W=xyz,
        log_scale=torch.randn(n, 3, generator=generator) * 0.4 - 2.3,
        quat=torch.randn(n, 4, generator=generator),
        opacity_logit=torch.randn(n, generator=generator) + opacity,
        sh=torch.randn(n, 4, 3, generator=generator) * 0.3,
    )


def test_two_gaussians_by_hand():
    """Red 0.8 at 2 m in front of green 0.5 at 3 m, looked at in the middle: w = 0.8 and 0.2 * 0.5."""
    params = rows((3.0, 2.0), (0.5, 0.8), ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)))
    stack = pixel_stack(project_splats(params, CAMERA, EYE), 20, 15)
    assert stack.row.tolist() == [1, 0]
    torch.testing.assert_close(stack.alpha, torch.tensor([0.8, 0.5]))
    torch.testing.assert_close(stack.transmittance, torch.tensor([1.0, 0.2]))
    torch.testing.assert_close(stack.weight, torch.tensor([0.8, 0.1]))
    torch.testing.assert_close(stack.colour, torch.tensor([0.8, 0.1, 0.0]), atol=1e-6, rtol=0)
    assert stack.light_left == pytest.approx(0.1)
    assert "2 Gaussians" in repr(stack)


def test_the_clamp_and_the_stop():
    """0.9999 is clamped to 0.99; the second would leave 1e-4 and is the last; a third gets nothing."""
    params = rows((1.0, 2.0, 3.0), (0.9999, 0.98, 0.9999), ((1.0, 0.0, 0.0),) * 3)
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
        worst = max(worst, float((stack.colour - image.rgb[v, u]).abs().max()))
        worst = max(worst, abs(1 - stack.light_left - float(image.alpha[v, u])))
        assert image.first_index is not None
        assert (int(stack.row[0]) if len(stack) else -1) == int(image.first_index[v, u])
    assert worst < 2e-5


def test_many_pixels_at_once_are_the_same(generator):
    splats = project_splats(random_map(100, generator), CAMERA, EYE)
    uv = torch.tensor([[3.5, 4.5], [20.5, 15.5], [30.5, 7.5]])
    blend = blend_at(splats, uv)
    for p, (u, v) in enumerate([(3, 4), (20, 15), (30, 7)]):
        stack = pixel_stack(splats, u, v)
        seen = blend.alpha[p] > 0
        assert blend.row[seen].tolist() == stack.row.tolist()
        torch.testing.assert_close(blend.weight[p][seen], stack.weight)


def test_an_empty_pixel_and_an_empty_map(generator):
    none = random_map(0, generator)
    stack = pixel_stack(project_splats(none, CAMERA, EYE), 0, 0)
    assert len(stack) == 0
    assert stack.light_left == 1.0
    assert stack.colour.tolist() == [0.0, 0.0, 0.0]
    assert "sum" in stack_table(stack)
