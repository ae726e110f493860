"""The fused CPU renderer against the reference: picture, indices, and every gradient."""

import math

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.geometry import quaternion, se3
from gsfusion_nb.render import render_forward, render_vjp
from gsfusion_nb.types import Camera, GaussianParams

pytest.importorskip("numba")

NAMES = ("xyz_W", "log_scale", "quat", "opacity_logit", "sh")
T_WC = se3.exp(torch.tensor([0.1, -0.2, 0.3, 0.2, -0.3, 0.1]))


def scene(n: int, degree: int, generator: torch.Generator, spread: float = 1.2) -> GaussianParams:
    """Gaussians in front of, beside and behind the camera; some nearly opaque, some below one grey level."""

    def normal(*size: int):
        return torch.randn(*size, generator=generator)

    in_camera = torch.stack([spread * normal(n), spread * normal(n), 2.0 + 1.5 * normal(n)], dim=-1)
    return GaussianParams(
        xyz_W=se3.apply(T_WC, in_camera),
        log_scale=math.log(0.08) + 0.5 * normal(n, 3),
        quat=quaternion.normalise(normal(n, 4)) * (0.5 + torch.rand(n, 1, generator=generator)),
        opacity_logit=3.0 * normal(n),
        sh=0.4 * normal(n, (degree + 1) ** 2, 3),
    )


def images(camera: Camera, generator: torch.Generator) -> list[torch.Tensor]:
    size = (camera.height, camera.width)
    return [torch.randn(shape, generator=generator) for shape in ((*size, 3), size, size)]


def both(params: GaussianParams, camera: Camera, v: list[torch.Tensor]):
    results = {}
    for backend in ("reference", "numba"):
        with use_backend(backend):
            out, saved = render_forward(params, camera, T_WC)
            results[backend] = out, render_vjp(saved, *v)
    return results["reference"], results["numba"]


def assert_close_but_for_flips(ours: torch.Tensor, theirs: torch.Tensor, share: float, atol: float):
    """A pair within rounding of the 1/255 cut or the 1e-4 stop may fall on either side, at a ``share`` of pixels."""
    off = (ours - theirs).abs() > atol
    worst = float((ours - theirs).abs().max())
    assert off.double().mean() <= share, f"{int(off.sum())} of {off.numel()} differ, the worst by {worst}"
    assert worst < 0.02


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize(("n", "width", "height"), [(0, 32, 16), (1, 16, 16), (37, 33, 17), (900, 95, 61)])
def test_picture_and_gradients(n, width, height, degree, generator):
    camera = Camera(width=width, height=height, fx=0.8 * width, fy=0.9 * width, cx=0.45 * width, cy=0.6 * height)
    params, v = scene(n, degree, generator), images(camera, generator)
    (a, grad_a), (b, grad_b) = both(params, camera, v)
    for name in ("rgb", "depth_m", "alpha"):
        assert_close_but_for_flips(getattr(b, name), getattr(a, name), share=2e-3, atol=2e-4)
    for name in ("first_index", "dominant_index"):
        assert (getattr(a, name) != getattr(b, name)).double().mean() <= 2e-3
    for name in NAMES:
        x, y = getattr(grad_a, name), getattr(grad_b, name)
        assert x.shape == y.shape
        assert torch.isfinite(y).all()
        # worst seen over these cases: 3e-3, where one pair flips at the 1/255 cut
        assert (x - y).norm() <= 1e-2 * x.norm() + 1e-6, name


def test_indices_are_optional(generator):
    camera = Camera(width=32, height=32, fx=30.0, fy=30.0, cx=16.0, cy=16.0)
    for backend in ("reference", "numba"):
        with use_backend(backend):
            out, _ = render_forward(scene(50, 0, generator), camera, T_WC, with_indices=False)
        assert out.first_index is None
        assert out.dominant_index is None


def test_closed_form_profile():
    """Isotropic 1 cm Gaussian on the axis at 2 m, fx 600: variance 9.3 px^2, alpha o exp(-d^2 / 18.6)."""
    camera = Camera(width=33, height=33, fx=600.0, fy=600.0, cx=16.5, cy=16.5)
    params = GaussianParams(
        xyz_W=torch.tensor([[0.0, 0.0, 2.0]]),
        log_scale=torch.full((1, 3), math.log(0.01)),
        quat=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacity_logit=torch.zeros(1),
        sh=torch.ones(1, 1, 3),
    )
    with use_backend("numba"):
        out, _ = render_forward(params, camera, torch.eye(4))
    expected = [0.5, 0.473828, 0.403249, 0.308196, 0.130389]
    assert [out.alpha[16, 16 + d].item() for d in (0, 1, 2, 3, 5)] == pytest.approx(expected, abs=2e-6)


def test_results_repeat_bit_for_bit_on_any_number_of_threads(generator):
    camera = Camera(width=95, height=61, fx=80.0, fy=80.0, cx=47.0, cy=30.0)
    params, v = scene(900, 3, generator), images(camera, generator)
    results = []
    with use_backend("numba"):
        for threads in (1, 2, 1):
            torch.set_num_threads(threads)
            out, saved = render_forward(params, camera, T_WC)
            results.append((out.rgb, *(getattr(render_vjp(saved, *v), name) for name in NAMES)))
    torch.set_num_threads(1)
    for other in results[1:]:
        assert all(torch.equal(x, y) for x, y in zip(results[0], other, strict=True))


def test_float64_goes_to_the_reference(generator):
    camera = Camera(width=16, height=16, fx=16.0, fy=16.0, cx=8.0, cy=8.0)
    p = scene(5, 0, generator)
    params = GaussianParams(**{name: getattr(p, name).double() for name in NAMES})
    with use_backend("numba"):
        out, saved = render_forward(params, camera, T_WC)
        grads = render_vjp(saved, torch.ones(16, 16, 3, dtype=torch.float64))
    assert out.rgb.dtype == grads.xyz_W.dtype == torch.float64
