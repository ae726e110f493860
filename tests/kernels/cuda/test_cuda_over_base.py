"""Blending over a base in CUDA: lists longer than a block brings at a time, clamped alphas, known
numbers."""

import pytest
import torch
from three_gaussians import three_gaussians

from gsfusion_nb.backends import use_backend
from gsfusion_nb.render import Base, render_over_base, render_over_base_vjp
from gsfusion_nb.types import GaussianParams

BEHIND_M = 0.1


def drawn(params, camera, pose, base, v_rgb):
    """The picture, the gradient and the record."""
    out, saved = render_over_base(params, camera, pose, base, behind_m=BEHIND_M)
    return out, render_over_base_vjp(saved, v_rgb), saved


def test_long_lists_and_clamped_alphas(make_scene, make_camera, pose, to, compare):
    """More Gaussians in a tile than a block brings at a time; half of them clamped at 0.99, some
    behind the surface."""
    camera = make_camera(48, 33)
    p = make_scene(800, 1, scale_m=0.12)
    logit = torch.where(p.opacity_logit > 0, 9.0, p.opacity_logit)
    params = GaussianParams(**{**vars(p), "opacity_logit": logit})
    g = torch.Generator().manual_seed(2)
    depth_m = 1.0 + 2.0 * torch.rand(33, 48, generator=g)
    depth_m[:9, :20] = 0.0
    base = Base(
        rgb=torch.rand(33, 48, 3, generator=g),
        depth_m=depth_m,
        weight=torch.rand(33, 48, generator=g).round(),
    )
    v_rgb = torch.randn(33, 48, 3, generator=g)
    with use_backend("reference"):
        expected, gradient, _ = drawn(params, camera, pose, base, v_rgb)
    with use_backend("cuda"):
        found, ours, saved = drawn(
            to(params),
            camera,
            to(pose),
            to(base),
            to(v_rgb),
        )
    assert int(saved.lists.offset.diff().max()) > 128
    assert float(expected.weight.max()) > 3
    for name, image in vars(found).items():
        compare("over base", name, image, getattr(expected, name), 1e-5, share=2e-3)
    for name, value in vars(ours).items():
        compare("over base", f"v_{name}", value, getattr(gradient, name), 2e-5, share=2e-3)


def test_three_gaussians_in_numbers(to):
    """The picture of tests/render/test_over_base.py, whose numbers were derived by hand, in
    float32."""
    params, camera, T_WC, base, target = three_gaussians(torch.float32)
    with use_backend("cuda"):
        out, saved = render_over_base(
            to(params),
            camera,
            to(T_WC),
            to(base),
            behind_m=BEHIND_M,
        )
        v = render_over_base_vjp(
            saved,
            (out.rgb - to(target)).sign() / target.numel(),
        )
    assert float(out.weight.sum()) == pytest.approx(16.249486960, rel=1e-5)
    assert out.rgb[6, 8].tolist() == pytest.approx(
        [0.367692344, 0.590253845, 0.408757275], abs=1e-6
    )
    assert float((out.rgb.cpu() - target).abs().mean()) == pytest.approx(0.100033292, abs=1e-6)
    assert v.xyz_W[1].tolist() == pytest.approx([-0.005346846, 0.001432013, -0.003219389], abs=2e-7)
    assert v.opacity_logit.tolist() == pytest.approx(
        [7.537970e-4, 8.594780e-4, -1.602534e-3], abs=2e-8
    )
