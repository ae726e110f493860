"""Lists of tiles, clamped pairs, frozen rows, tensors with gaps; the rest is in
``test_cuda_pictures.py``."""

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.geometry import quaternion
from gsfusion_nb.render import render_forward, render_vjp
from gsfusion_nb.types import Camera, GaussianParams


def test_many_gaussians_in_a_tile(
    make_scene, make_camera, make_images, draw_both, compare_pictures, compare_gradients
):
    """Lists longer than the 128 entries that a block keeps, Gaussians of many tiles, and pixels
    that go dark early."""
    camera = make_camera(48, 33)
    params = make_scene(800, 0, scale_m=0.12)
    pictures, gradients, saved = draw_both(params, camera, make_images(camera), opaque_alpha=0.6)
    assert int(saved.lists.offset.diff().max()) > 128
    compare_pictures(*pictures)
    compare_gradients(*gradients)


def test_clamped_pairs_have_no_gradient(
    make_scene, make_camera, make_images, draw_both, compare, compare_gradients
):
    """Half of the Gaussians are so opaque that alpha is clamped at 0.99 around their centres."""
    camera = make_camera(40, 24)
    p = make_scene(40, 0, scale_m=0.4)
    params = GaussianParams(
        **{**vars(p), "opacity_logit": torch.where(p.opacity_logit > 0, 9.0, -1.0)}
    )
    (ours, theirs), gradients, _ = draw_both(params, camera, make_images(camera))
    assert (theirs.alpha > 0.98).sum() > 50
    compare("clamped", "alpha", ours.alpha, theirs.alpha, 1e-5, share=2e-3)
    compare_gradients(*gradients, operation="clamped")


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_gradient_of_the_viewing_direction(
    degree, make_scene, make_camera, make_images, pose, to, compare
):
    """Gaussians so large that the picture is flat, in strong colours: a centre matters for the
    direction only."""
    camera = make_camera(20, 16)
    p = make_scene(24, degree)
    flat = {
        "log_scale": torch.full((24, 3), 4.0),
        "opacity_logit": torch.full((24,), -3.0),
        "sh": 8.0 * p.sh,
    }
    params = GaussianParams(**{**vars(p), **flat})
    v = [x.abs() for x in make_images(camera)]
    _, saved = render_forward.reference(params, camera, pose)
    expected = render_vjp.reference(saved, v[0])
    with use_backend("cuda"):
        found = render_vjp(
            render_forward(to(params), camera, to(pose))[1],
            to(v[0]),
        )
    for name in ("xyz_W", "sh"):
        compare("direction", name, getattr(found, name), getattr(expected, name), 2e-5)


def test_no_tile_is_listed_in_vain_and_none_is_missing(make_scene, make_camera, pose, to):
    """A tile lists a Gaussian where its alpha reaches 1/255 at a pixel, and hardly anywhere
    else."""
    camera = make_camera(96, 80)
    params = make_scene(40, 0)
    with use_backend("cuda"):
        _, saved = render_forward(to(params), camera, to(pose))
    s = saved.splats.cpu()
    lists = saved.lists
    x = torch.arange(96) + 0.5
    y = torch.arange(80) + 0.5
    listed = torch.zeros(40, 30, dtype=torch.bool)
    needed = torch.zeros(40, 30, dtype=torch.bool)
    for t in range(30):
        listed[lists.ids[lists.offset[t] : lists.offset[t + 1]].long().cpu(), t] = True
    for g in (saved.depth.cpu() < float("inf")).nonzero()[:, 0].tolist():
        u, v, A, B, C, ln_o = s[g, :6].double()
        dx = x[None] - u
        dy = y[:, None] - v
        seen = (
            ln_o - 0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy
            > torch.tensor(1 / 255.0).double().log()
        )
        needed[g] = seen.view(5, 16, 6, 16).any(3).any(1).flatten()
    assert listed[needed].all()
    assert needed.sum() > 50
    assert (listed & ~needed).sum() <= 0.1 * needed.sum()


def test_gradients_of_needles_keep_their_digits(to):
    """Of 1000:1, against float64: -Q v_Q Q has entries as large as 1 / blur^2, which cancel along
    the needle."""
    n = 6
    camera = Camera(
        width=40,
        height=30,
        fx=300.0,
        fy=300.0,
        cx=20.0,
        cy=15.0,
    )
    generator = torch.Generator().manual_seed(0)
    place = torch.rand(n, 3, generator=generator) * torch.tensor([0.2, 0.15, 0.5]) + torch.tensor(
        [-0.1, -0.08, 2.0]
    )
    params = GaussianParams(
        xyz_W=place,
        log_scale=torch.tensor([0.3, 3e-4, 3e-4]).log().repeat(n, 1),
        quat=quaternion.normalise(torch.randn(n, 4, generator=generator)),
        opacity_logit=torch.randn(n, generator=generator),
        sh=0.4 * torch.randn(n, 1, 3, generator=generator),
    )
    v_rgb = torch.randn(camera.height, camera.width, 3, generator=generator)
    exact = GaussianParams(**{name: value.double() for name, value in vars(params).items()})
    _, saved = render_forward.reference(
        exact,
        camera,
        torch.eye(4, dtype=torch.float64),
    )
    expected = render_vjp.reference(saved, v_rgb.double())
    with use_backend("cuda"):
        found = render_vjp(
            render_forward(to(params), camera, to(torch.eye(4)))[1],
            to(v_rgb),
        )
    for name in ("log_scale", "quat", "xyz_W"):
        value = getattr(found, name).cpu().double()
        true = getattr(expected, name)
        assert (value - true).abs().max() < 1e-3 * true.abs().max(), name
