import dataclasses

import pytest
import torch

from gsfusion_nb.render import project_gaussians, project_gaussians_vjp
from gsfusion_nb.types import Camera, GaussianParams


def one_on_the_axis(**changes) -> GaussianParams:
    row = {
        "xyz_W": torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64),
        "log_scale": torch.full((1, 3), 0.01, dtype=torch.float64).log(),
        "quat": torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        "opacity_logit": torch.zeros(1, dtype=torch.float64),
        "sh": torch.zeros(1, 1, 3, dtype=torch.float64),
    }
    return GaussianParams(**{**row, **changes})


CAMERA_600 = Camera(width=21, height=21, fx=600.0, fy=600.0, cx=10.5, cy=10.5)
EYE = torch.eye(4, dtype=torch.float64)


def test_isotropic_on_the_axis_by_hand():
    p = project_gaussians(one_on_the_axis(), CAMERA_600, EYE)
    assert p.uv.tolist() == [[10.5, 10.5]]
    torch.testing.assert_close(1 / p.conic[0, 0], torch.tensor(9.3, dtype=torch.float64))  # (600 * 0.01 / 2)^2 + 0.3
    assert p.conic[0, 1] == 0
    assert p.depth_m.item() == 2
    assert p.opacity.item() == 0.5
    reach = (2 * torch.log(torch.tensor(127.5, dtype=torch.float64)) * 9.3).sqrt()
    torch.testing.assert_close(p.extent_px, reach.expand(1, 2))


def test_extent_is_where_alpha_falls_to_one_grey_level(book, generator):
    p = project_gaussians(book.random_map(generator, 20), book.camera, book.pose)
    A, B, C = p.conic.unbind(-1)
    # rightmost point of the ellipse: dy = -B/C dx
    dx = p.extent_px[:, 0]
    dy = -B / C * dx
    alpha = p.opacity * torch.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy)
    torch.testing.assert_close(alpha, torch.full_like(alpha, 1 / 255))


def test_near_plane_and_faint_gaussians_are_not_visible():
    xyz = torch.tensor([[0.0, 0, 0.2], [0, 0, 0.21], [0, 0, -1], [0, 0, 0]], dtype=torch.float64)
    many = GaussianParams(
        **{
            f.name: getattr(one_on_the_axis(), f.name).repeat_interleave(4, 0)
            for f in dataclasses.fields(GaussianParams)
        }
    )
    p = project_gaussians(dataclasses.replace(many, xyz_W=xyz), CAMERA_600, EYE)
    assert p.visible.tolist() == [False, True, False, False]
    assert torch.isfinite(p.uv).all()
    assert torch.isfinite(p.conic).all()
    faint = one_on_the_axis(opacity_logit=torch.tensor([1 / 256], dtype=torch.float64).logit())
    assert not project_gaussians(faint, CAMERA_600, EYE).visible.any()


def test_agrees_with_the_textbook(book, generator):
    params = book.random_map(generator, 30)
    p = project_gaussians(params, book.camera, book.pose)
    u, v, cov, z, opacity, _ = book.splat(params, book.camera, book.pose)
    Q = torch.linalg.inv(cov)
    torch.testing.assert_close(p.uv, torch.stack([u, v], -1))
    torch.testing.assert_close(p.conic, torch.stack([Q[:, 0, 0], Q[:, 0, 1], Q[:, 1, 1]], -1))
    torch.testing.assert_close(p.depth_m, z)
    torch.testing.assert_close(p.opacity, opacity)


def test_needle_keeps_its_digits_in_float32():
    # 3 px^2 across and 1e6 px^2 along the diagonal: cov_uu cov_vv - cov_uv^2 would lose all digits in float32
    needle = one_on_the_axis(
        log_scale=torch.tensor([[3.3, 0.005, 0.005]], dtype=torch.float64).log(),
        quat=torch.tensor([[0.9238795325, 0, 0, 0.3826834324]], dtype=torch.float64),
    )
    single = GaussianParams(**{f.name: getattr(needle, f.name).float() for f in dataclasses.fields(GaussianParams)})
    exact = project_gaussians(needle, CAMERA_600, EYE).conic
    torch.testing.assert_close(
        project_gaussians(single, CAMERA_600, EYE.float()).conic.double(), exact, rtol=1e-5, atol=0
    )


def wide(book, generator):
    """Some Gaussians so far out that J is clamped, on each side."""
    params = book.random_map(generator, 12)
    shift = torch.zeros(12, 3, dtype=torch.float64)
    shift[0, 0], shift[1, 0], shift[2, 1], shift[3, 1] = 4.0, -4.0, 4.0, -4.0
    return dataclasses.replace(params, xyz_W=params.xyz_W + shift)


def columns(params):
    return params.xyz_W, params.log_scale, params.quat, params.opacity_logit


def forward_of(book, params):
    def forward(xyz_W, log_scale, quat, opacity_logit):
        moved = GaussianParams(xyz_W=xyz_W, log_scale=log_scale, quat=quat, opacity_logit=opacity_logit, sh=params.sh)
        p = project_gaussians(moved, book.camera, book.pose)
        return p.uv, p.conic, p.depth_m, p.opacity

    return forward


def vjp_of(book, params):
    def vjp(x, *v):
        moved = GaussianParams(xyz_W=x[0], log_scale=x[1], quat=x[2], opacity_logit=x[3], sh=params.sh)
        g = project_gaussians_vjp(moved, book.camera, book.pose, *v)
        return g.xyz_W, g.log_scale, g.quat, g.opacity_logit

    return vjp


def test_vjp_is_the_autograd_of_the_forward(book, generator):
    params = wide(book, generator)
    leaves = [x.clone().requires_grad_() for x in columns(params)]
    out = forward_of(book, params)(*leaves)
    v = [torch.randn(o.shape, generator=generator, dtype=torch.float64) for o in out]
    expected = torch.autograd.grad(out, leaves, v)
    torch.testing.assert_close(vjp_of(book, params)(columns(params), *v), expected)


def test_vjp_by_finite_differences(book, generator):
    params = wide(book, generator)
    book.finite_difference_check(forward_of(book, params), vjp_of(book, params), columns(params), generator)


def test_hidden_rows_get_no_gradient():
    behind = one_on_the_axis(xyz_W=torch.tensor([[0.1, 0.1, -2.0]], dtype=torch.float64))
    one = torch.ones(1, dtype=torch.float64)
    g = project_gaussians_vjp(behind, CAMERA_600, EYE, one.expand(1, 2), one.expand(1, 3), one, 0 * one)
    assert all((getattr(g, name) == 0).all() for name in ("xyz_W", "log_scale", "quat", "opacity_logit"))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_gaussians(book, generator, dtype):
    p = project_gaussians(book.random_map(generator, 0, dtype=dtype), book.camera, book.pose)
    assert p.uv.shape == (0, 2)
    assert p.uv.dtype == dtype
