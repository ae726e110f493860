"""The renderer of the CPU, numba, against the reference: picture, indices, and every gradient."""

import math

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.geometry import quaternion, se3
from gsfusion_nb.render import render_forward, render_vjp
from gsfusion_nb.types import Camera, GaussianParams

pytest.importorskip("numba")

NAMES = ("xyz_W", "log_scale", "quat", "opacity_logit", "sh")
SIZES = [(0, 32, 16), (1, 16, 16), (37, 33, 17), (900, 95, 61)]
IMAGES = ("rgb", "depth_m", "alpha", "first_index", "dominant_index", "hit_index")
T_WC = se3.exp(torch.tensor([0.1, -0.2, 0.3, 0.2, -0.3, 0.1]))


def scene(
    n: int,
    degree: int,
    generator: torch.Generator,
    spread: float = 1.2,
) -> GaussianParams:
    """Gaussians in front of, beside and behind the camera; some nearly opaque, some below one grey
    level."""

    def normal(*size: int):
        return torch.randn(*size, generator=generator)

    in_camera = torch.stack(
        [spread * normal(n), spread * normal(n), 2.0 + 1.5 * normal(n)],
        dim=-1,
    )
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


def masks(
    height: int,
    width: int,
    generator: torch.Generator,
) -> list[torch.Tensor]:
    """None, all, one, rectangles that cut tiles, and a third of the pixels at random."""
    blobs = torch.zeros(height, width, dtype=torch.bool)
    blobs[height // 3 : height // 2, : width // 3] = True
    blobs[: height // 4, width // 2 : width // 2 + 5] = True
    one = torch.zeros_like(blobs)
    one[height // 2, width // 2] = True
    return [
        one & False,
        one | True,
        one,
        blobs,
        torch.rand(height, width, generator=generator) < 0.33,
    ]


def both(params: GaussianParams, camera: Camera, v: list[torch.Tensor]):
    results = {}
    for name in ("reference", "numba"):
        with use_backend(name):
            out, saved = render_forward(params, camera, T_WC)
            results[name] = out, render_vjp(saved, *v)
    return results["reference"], results["numba"]


def assert_close_but_for_flips(ours: torch.Tensor, theirs: torch.Tensor, share: float, atol: float):
    """A pair within rounding of the 1/255 cut or the 1e-4 stop may fall on either side, at a
    ``share`` of pixels."""
    off = (ours - theirs).abs() > atol
    worst = float((ours - theirs).abs().max())
    assert off.double().mean() <= share, (
        f"{int(off.sum())} of {off.numel()} differ, the worst by {worst}"
    )
    assert worst < 0.02


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize(("n", "width", "height"), SIZES)
def test_picture_and_gradients(n, width, height, degree, generator, make_camera):
    camera = make_camera(width, height)
    params = scene(n, degree, generator)
    v = images(camera, generator)
    (a, grad_a), (b, grad_b) = both(params, camera, v)
    for name in ("rgb", "depth_m", "alpha"):
        assert_close_but_for_flips(getattr(b, name), getattr(a, name), share=2e-3, atol=2e-4)
    for name in ("first_index", "dominant_index"):
        assert (getattr(a, name) != getattr(b, name)).double().mean() <= 2e-3
    for name in NAMES:
        x = getattr(grad_a, name)
        y = getattr(grad_b, name)
        assert x.shape == y.shape
        assert torch.isfinite(y).all()
        # worst seen over these cases: 3e-3, where one pair flips at the 1/255 cut
        assert (x - y).norm() <= 1e-2 * x.norm() + 1e-6, name


def test_results_repeat_bit_for_bit_on_any_number_of_threads(generator):
    camera = Camera(
        width=95,
        height=61,
        fx=80.0,
        fy=80.0,
        cx=47.0,
        cy=30.0,
    )
    params = scene(900, 3, generator)
    v = images(camera, generator)
    results = []
    with use_backend("numba"):
        for threads in (1, 2, 1):
            torch.set_num_threads(threads)
            out, saved = render_forward(params, camera, T_WC)
            results.append((out.rgb, *(getattr(render_vjp(saved, *v), name) for name in NAMES)))
    torch.set_num_threads(1)
    for other in results[1:]:
        assert all(torch.equal(x, y) for x, y in zip(results[0], other, strict=True))


@pytest.mark.parametrize(("n", "width", "height"), SIZES)
def test_masked_picture_is_the_whole_one_bit_for_bit(n, width, height, generator, make_camera):
    params = scene(n, 1, generator)
    camera = make_camera(width, height)
    with use_backend("numba"):
        whole, _ = render_forward(params, camera, T_WC, opaque_alpha=0.6)
        for pixels in masks(height, width, generator):
            out, _ = render_forward(params, camera, T_WC, opaque_alpha=0.6, pixels=pixels)
            for image in IMAGES:
                found = getattr(out, image)
                assert torch.equal(found[pixels], getattr(whole, image)[pixels])
                assert (found[~pixels] == (-1 if "index" in image else 0)).all()


@pytest.mark.parametrize(("n", "width", "height"), SIZES)
def test_masked_gradients(n, width, height, generator, make_camera):
    params = scene(n, 2, generator)
    camera = make_camera(width, height)
    v = images(camera, generator)
    rows = torch.rand(n, generator=generator) < 0.4
    for pixels in masks(height, width, generator):
        v_nonsense = [
            torch.where(
                pixels[..., None] if x.ndim == 3 else pixels,
                x,
                torch.nan,
            )
            for x in v
        ]
        v_masked = [x * (pixels[..., None] if x.ndim == 3 else pixels) for x in v]
        with use_backend("reference"):
            slow = render_vjp(
                render_forward(params, camera, T_WC, pixels=pixels)[1],
                *v,
                rows=rows,
            )
        with use_backend("numba"):
            whole = render_vjp(render_forward(params, camera, T_WC)[1], *v_masked)
            _, saved = render_forward(params, camera, T_WC, pixels=pixels)
            full = render_vjp(saved, *v_nonsense)
            some = render_vjp(saved, *v, rows=rows)
        for name in NAMES:
            w, f, s, e = (getattr(g, name) for g in (whole, full, some, slow))
            torch.testing.assert_close(
                f,
                w,
                rtol=1e-5,
                atol=1e-6 * float(w.abs().max()) if n else 0,
            )
            torch.testing.assert_close(
                s[rows],
                f[rows],
                rtol=1e-5,
                atol=1e-6 * float(w.abs().max()) if n else 0,
            )
            assert not s[~rows].any()
            # worst seen 3e-3, where one pair flips at the 1/255 cut
            assert (s - e).norm() <= 1e-2 * e.norm() + 1e-6, name


def test_large_gaussians_off_the_image_are_drawn(generator, make_camera):
    """Centres up to ten image widths away; what is listed must not depend on where the centre
    is."""
    n = 250
    camera = make_camera(159, 121)
    p = scene(n, 0, generator, spread=8.0)
    params = GaussianParams(**{**vars(p), "log_scale": p.log_scale + math.log(20.0)})
    v = images(camera, generator)
    (a, grad_a), (b, grad_b) = both(params, camera, v)
    assert_close_but_for_flips(b.alpha, a.alpha, share=2e-3, atol=2e-4)
    assert (a.alpha > 0.5).double().mean() > 0.5
    for name in NAMES:
        x = getattr(grad_a, name)
        y = getattr(grad_b, name)
        assert (x - y).norm() <= 1e-2 * x.norm() + 1e-6, name


@pytest.mark.parametrize(
    ("long_m", "ratio"),
    [(0.3, 100.0), (0.3, 1000.0), (1.0, 1000.0)],
)
def test_gradients_of_needles_keep_their_digits(long_m, ratio, generator):
    """Against float64: -Q v_Q Q of a needle has entries as large as 1 / blur^2, which cancel along
    the needle."""
    n = 15
    camera = Camera(
        width=80,
        height=60,
        fx=300.0,
        fy=300.0,
        cx=40.0,
        cy=30.0,
    )
    log_scale = torch.full((n, 3), math.log(long_m / ratio))
    log_scale[:, 0] = math.log(long_m)
    place = torch.rand(n, 3, generator=generator) * torch.tensor([0.4, 0.3, 0.5]) + torch.tensor(
        [-0.2, -0.15, 2.0]
    )
    params = GaussianParams(
        xyz_W=place,
        log_scale=log_scale,
        quat=quaternion.normalise(torch.randn(n, 4, generator=generator)),
        opacity_logit=torch.randn(n, generator=generator),
        sh=0.4 * torch.randn(n, 1, 3, generator=generator),
    )
    v_rgb = torch.randn(camera.height, camera.width, 3, generator=generator)
    exact = GaussianParams(**{name: value.double() for name, value in vars(params).items()})
    with use_backend("reference"):
        expected = render_vjp(
            render_forward(exact, camera, torch.eye(4, dtype=torch.float64))[1],
            v_rgb.double(),
        )
    with use_backend("numba"):
        found = render_vjp(render_forward(params, camera, torch.eye(4))[1], v_rgb)
    for name in ("log_scale", "quat", "xyz_W"):
        value = getattr(found, name).double()
        true = getattr(expected, name)
        # worst seen: 1.4e-4; before: 0.08, 0.09 and 6.9 for log scales
        assert (value - true).abs().max() < 1e-3 * true.abs().max(), name
