"""Picture, indices and gradients; lists of tiles, clamped pairs and gaps are in
``test_cuda_render.py``."""

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.render import render_forward, render_vjp
from gsfusion_nb.types import Camera, GaussianParams

NAMES = ("xyz_W", "log_scale", "quat", "opacity_logit", "sh")
SIZES = [(0, 32, 16), (1, 16, 16), (60, 48, 40), (37, 33, 17)]


def test_gradients_are_the_differences_of_the_reference_in_float64(
    make_scene, make_camera, make_images, pose, to
):
    """d sum(v . images) along a random direction of each parameter, by central differences."""
    camera = make_camera(32, 24)
    params = make_scene(20, 1, scale_m=0.15)
    v = make_images(camera)
    with use_backend("cuda"):
        _, saved = render_forward(to(params), camera, to(pose))
        found = render_vjp(saved, *to(v))
    double = {name: getattr(params, name).double() for name in NAMES}

    def loss(name, moved):
        out, _ = render_forward.reference(
            GaussianParams(**{**double, name: moved}), camera, pose.double()
        )
        return float(
            sum((a * b).sum() for a, b in zip((out.rgb, out.depth_m, out.alpha), v, strict=True))
        )

    for name in NAMES:
        direction = torch.randn(
            double[name].shape,
            generator=torch.Generator().manual_seed(1),
            dtype=torch.float64,
        )
        h = 1e-6
        ends = [loss(name, double[name] + s * h * direction) for s in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * h)
        along = float((getattr(found, name).cpu().double() * direction).sum())
        assert along == pytest.approx(difference, rel=2e-4, abs=1e-3), name


def test_a_wall_stops_the_light_and_hits_go_on_behind_it(to):
    """Three walls of alpha 0.99, 0.99, 0.99: the third would leave 1e-6 of the light, and so is not
    blended."""
    n = 3
    camera = Camera(
        width=16,
        height=16,
        fx=16.0,
        fy=16.0,
        cx=8.0,
        cy=8.0,
    )
    params = GaussianParams(
        xyz_W=torch.tensor([[0.0, 0.0, 1.0 + i] for i in range(n)]),
        log_scale=torch.full((n, 3), 3.0),
        quat=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(n, 4),
        opacity_logit=torch.tensor([0.0, 0.5, 20.0]),
        sh=torch.ones(n, 1, 3),
    )
    theirs, _ = render_forward.reference(params, camera, torch.eye(4), opaque_alpha=0.9)
    with use_backend("cuda"):
        ours, _ = render_forward(to(params), camera, torch.eye(4), opaque_alpha=0.9)
    assert (ours.hit_index == 2).all()
    for name in ("first_index", "dominant_index", "hit_index"):
        assert torch.equal(getattr(ours, name).cpu(), getattr(theirs, name))


def test_large_gaussians_off_the_image(
    make_scene, make_camera, make_images, draw_both, compare, compare_gradients
):
    camera = make_camera(70, 40)
    p = make_scene(30, 0)
    params = GaussianParams(**{**vars(p), "log_scale": p.log_scale + 3.0, "xyz_W": p.xyz_W * 4.0})
    (ours, theirs), gradients, _ = draw_both(params, camera, make_images(camera))
    compare("large Gaussians", "alpha", ours.alpha, theirs.alpha, 1e-4, share=2e-3)
    compare_gradients(*gradients, 1e-3, operation="large Gaussians")
