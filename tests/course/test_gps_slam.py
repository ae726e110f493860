"""Chapter 12: the learner's blending and gradient are the library's, and run in it."""

import pytest
import torch

from gsfusion_nb import backends
from gsfusion_nb.backends import use_backend
from gsfusion_nb.course import becomes, exercises, mine
from gsfusion_nb.render.over_base import (
    Base,
    blend_with_base,
    blend_with_base_vjp,
    not_behind,
    render_over_base,
    render_over_base_vjp,
)
from gsfusion_nb.types import Camera, GaussianParams

CAMERA = Camera(width=24, height=18, fx=20.0, fy=20.0, cx=12.0, cy=9.0)
EYE = torch.eye(4)


@pytest.fixture(autouse=True)
def solutions_are_kept(monkeypatch):
    for kept in (backends.FUNCTIONS, becomes.KEPT):
        for name in list(kept):
            monkeypatch.delitem(kept, name)
    for name, exercise in exercises().items():
        if exercise.chapter == 12:
            mine.keep(name, exercise._solution)
    mine.clear_counts()
    yield
    mine.forget()
    mine.clear_counts()


@pytest.fixture
def params(generator):
    n = 12
    xyz = torch.rand(n, 3, generator=generator) * torch.tensor([1.6, 1.2, 0.2]) + torch.tensor([-0.8, -0.6, 1.9])
    return GaussianParams(
        xyz_W=xyz, log_scale=torch.full((n, 3), -2.5), quat=torch.randn(n, 4, generator=generator),
        opacity_logit=torch.randn(n, generator=generator), sh=torch.randn(n, 1, 3, generator=generator) * 0.3,
    )  # fmt: skip


def base(weight):
    size = (CAMERA.height, CAMERA.width)
    return Base(rgb=torch.full((*size, 3), 0.4), depth_m=torch.full(size, 2.0), weight=torch.full(size, weight))


def seen(params, weight):
    output, saved = render_over_base(params, CAMERA, EYE, base(weight), behind_m=0.1)
    return output, render_over_base_vjp(saved, output.rgb - 0.5)


@pytest.mark.parametrize(("weight", "own"), [(1.0, True), (0.0, False)])
def test_pictures_and_gradients_are_made_by_the_learner(params, weight, own):
    """Where a hole has no weight, the exercise says nothing, and the reference draws."""
    with use_backend("reference"):
        expected, gradient = seen(params, weight)
    with use_backend("mine"):
        output, by_you = seen(params, weight)
    torch.testing.assert_close(output.rgb, expected.rgb, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(output.weight, expected.weight, rtol=1e-5, atol=1e-6)
    for name, value in vars(gradient).items():
        torch.testing.assert_close(getattr(by_you, name), value, rtol=1e-4, atol=1e-5)
    assert backends.CALLS["not_behind"].own > 0
    for operation in ("blend_with_base", "blend_with_base_vjp"):
        calls = backends.CALLS[operation]
        assert (calls.own > 0) == own, operation
        assert (calls.reference > 0) != own, operation


def test_no_gaussians_and_no_pixels():
    none, colours, depth_m = torch.zeros(0, 4), torch.zeros(0, 3), torch.full((4,), 2.0)
    C_s, b = torch.rand(4, 3, generator=torch.Generator().manual_seed(1)), torch.ones(4)
    with use_backend("mine"):
        assert not_behind(none, b[:0], depth_m, 0.1).shape == (0, 4)
        assert not_behind(torch.zeros(2, 0), b[:2], depth_m[:0], 0.1).shape == (2, 0)
        C, W = blend_with_base(none, colours, C_s, b)
        v_w, v_c = blend_with_base_vjp(none, colours, C, b, C_s)
        empty, _ = blend_with_base(none[:, :0], colours, C_s[:0], b[:0])
    assert torch.equal(C, C_s)
    assert not W.any()
    assert (v_w.shape, v_c.shape, empty.shape) == ((0, 4), (0, 3), (0, 3))
