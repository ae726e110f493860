"""The gradient to the camera's pose, checked against autograd through the stages and against
central differences."""

import dataclasses
import math

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.geometry import project, quaternion, se3
from gsfusion_nb.geometry.spherical_harmonics import sh_to_rgb
from gsfusion_nb.render import (
    composite,
    pose_vjp,
    project_gaussians,
    project_gaussians_vjp,
    render,
    render_autograd,
    render_forward,
    render_vjp,
)
from gsfusion_nb.render import tile_intersections as tiles_of
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


CAMERA_600 = Camera(
    width=21,
    height=21,
    fx=600.0,
    fy=600.0,
    cx=10.5,
    cy=10.5,
)
EYE = torch.eye(4, dtype=torch.float64)


def test_isotropic_on_the_axis_by_hand():
    p = project_gaussians(one_on_the_axis(), CAMERA_600, EYE)
    assert p.uv.tolist() == [[10.5, 10.5]]
    # (600 * 0.01 / 2)^2 + 0.3
    torch.testing.assert_close(1 / p.conic[0, 0], torch.tensor(9.3, dtype=torch.float64))
    assert p.conic[0, 1] == 0
    assert p.depth_m.item() == 2
    assert p.opacity.item() == 0.5
    reach = (2 * torch.log(torch.tensor(127.5, dtype=torch.float64)) * 9.3).sqrt()
    torch.testing.assert_close(p.extent_px, reach.expand(1, 2))


def test_extent_is_where_alpha_falls_to_one_grey_level(scene, generator):
    p = project_gaussians(scene.random_map(generator, 20), scene.camera, scene.pose)
    A, B, C = p.conic.unbind(-1)
    # rightmost point of the ellipse: dy = -B/C dx
    dx = p.extent_px[:, 0]
    dy = -B / C * dx
    alpha = p.opacity * torch.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy)
    torch.testing.assert_close(alpha, torch.full_like(alpha, 1 / 255))


def test_near_plane_and_faint_gaussians_are_not_visible():
    xyz = torch.tensor(
        [[0.0, 0, 0.2], [0, 0, 0.21], [0, 0, -1], [0, 0, 0]],
        dtype=torch.float64,
    )
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


def test_covariance_is_the_3d_one_through_the_derivative_of_the_projection(scene, generator):
    """The derivative of pixel by world point is found by autograd, and the 3D covariance is a sum
    over the axes."""
    params = scene.random_map(generator, 30)
    T_CW = se3.inverse(scene.pose)  # nothing is clamped
    camera = dataclasses.replace(scene.camera, width=54, height=38)
    p = project_gaussians(params, camera, scene.pose)
    for i in range(30):
        xyz_W = params.xyz_W[i]
        J = torch.autograd.functional.jacobian(lambda x: project(camera, se3.apply(T_CW, x)), xyz_W)
        axes = quaternion.to_matrix(params.quat[i]) * params.log_scale[i].exp()
        cov = sum(torch.outer(J @ axis, J @ axis) for axis in axes.T) + 0.3 * torch.eye(2)
        A, B, C = p.conic[i]
        torch.testing.assert_close(
            torch.stack([A, B, B, C]).view(2, 2) @ cov,
            torch.eye(2, dtype=torch.float64),
        )
        torch.testing.assert_close(p.uv[i], project(camera, se3.apply(T_CW, xyz_W)))
        torch.testing.assert_close(p.depth_m[i], se3.apply(T_CW, xyz_W)[2])
    torch.testing.assert_close(p.opacity, params.opacity_logit.sigmoid())


def test_jacobian_is_clamped_outside_the_view_by_hand():
    """A ball at x/z = 1 where the half field of view is 10.5 / 600: J sees it at 1.3 times that."""
    xyz = torch.tensor([[2.0, 0, 2]], dtype=torch.float64)
    p = project_gaussians(one_on_the_axis(xyz_W=xyz), CAMERA_600, EYE)
    tx = 1.3 * 10.5 / 600
    torch.testing.assert_close(
        1 / p.conic[0, 0],
        xyz.new_tensor(3.0**2 * (1 + tx**2) + 0.3),
    )
    torch.testing.assert_close(1 / p.conic[0, 2], xyz.new_tensor(9.3))
    assert p.uv[0, 0].item() == pytest.approx(610.5)


def test_axes_of_a_turned_gaussian_by_hand():
    """Standard deviations 1, 2 and 3 cm along x, y and z, turned by 90 degrees about z: 2 cm lie
    along u."""
    half = math.sqrt(0.5)
    params = one_on_the_axis(
        log_scale=torch.tensor([[0.01, 0.02, 0.03]], dtype=torch.float64).log(),
        quat=torch.tensor([[half, 0, 0, half]], dtype=torch.float64),
    )
    p = project_gaussians(params, CAMERA_600, EYE)
    # (600 * 0.02 / 2)^2 + 0.3
    expected = torch.tensor([[1 / 36.3, 0, 1 / 9.3]], dtype=torch.float64)
    torch.testing.assert_close(p.conic, expected)


def test_needle_keeps_its_digits_in_float32():
    # 3 px^2 across and 1e6 px^2 along the diagonal: cov_uu cov_vv - cov_uv^2 would lose all digits
    # in float32
    needle = one_on_the_axis(
        log_scale=torch.tensor([[3.3, 0.005, 0.005]], dtype=torch.float64).log(),
        quat=torch.tensor([[0.9238795325, 0, 0, 0.3826834324]], dtype=torch.float64),
    )
    single = GaussianParams(
        **{f.name: getattr(needle, f.name).float() for f in dataclasses.fields(GaussianParams)}
    )
    exact = project_gaussians(needle, CAMERA_600, EYE).conic
    torch.testing.assert_close(
        project_gaussians(single, CAMERA_600, EYE.float()).conic.double(),
        exact,
        rtol=1e-5,
        atol=0,
    )


def wide(scene, generator):
    """Some Gaussians so far out that J is clamped, on each side."""
    params = scene.random_map(generator, 12)
    shift = torch.zeros(12, 3, dtype=torch.float64)
    shift[0, 0] = 4.0
    shift[1, 0] = -4.0
    shift[2, 1] = 4.0
    shift[3, 1] = -4.0
    return dataclasses.replace(params, xyz_W=params.xyz_W + shift)


def columns(params):
    return params.xyz_W, params.log_scale, params.quat, params.opacity_logit


def forward_of(scene, params):
    def forward(xyz_W, log_scale, quat, opacity_logit):
        moved = GaussianParams(
            xyz_W=xyz_W, log_scale=log_scale, quat=quat, opacity_logit=opacity_logit, sh=params.sh
        )
        p = project_gaussians(moved, scene.camera, scene.pose)
        return p.uv, p.conic, p.depth_m, p.opacity

    return forward


def vjp_of(scene, params):
    def vjp(x, *v):
        moved = GaussianParams(
            xyz_W=x[0],
            log_scale=x[1],
            quat=x[2],
            opacity_logit=x[3],
            sh=params.sh,
        )
        g = project_gaussians_vjp(moved, scene.camera, scene.pose, *v)
        return g.xyz_W, g.log_scale, g.quat, g.opacity_logit

    return vjp


def test_vjp_is_the_autograd_of_the_forward(scene, generator):
    params = wide(scene, generator)
    leaves = [x.clone().requires_grad_() for x in columns(params)]
    out = forward_of(scene, params)(*leaves)
    v = [torch.randn(o.shape, generator=generator, dtype=torch.float64) for o in out]
    expected = torch.autograd.grad(out, leaves, v)
    torch.testing.assert_close(vjp_of(scene, params)(columns(params), *v), expected)


def test_vjp_by_finite_differences(scene, generator):
    params = wide(scene, generator)
    scene.finite_difference_check(
        forward_of(scene, params), vjp_of(scene, params), columns(params), generator
    )


def test_hidden_rows_get_no_gradient():
    behind = one_on_the_axis(xyz_W=torch.tensor([[0.1, 0.1, -2.0]], dtype=torch.float64))
    one = torch.ones(1, dtype=torch.float64)
    g = project_gaussians_vjp(
        behind,
        CAMERA_600,
        EYE,
        one.expand(1, 2),
        one.expand(1, 3),
        one,
        0 * one,
    )
    assert all(
        (getattr(g, name) == 0).all() for name in ("xyz_W", "log_scale", "quat", "opacity_logit")
    )


def images_vjp(generator, camera):
    v = torch.randn(
        5,
        camera.height,
        camera.width,
        generator=generator,
        dtype=torch.float64,
    )
    return v[:3].permute(1, 2, 0), v[3], v[4]


def weighted(images, v):
    return torch.stack(
        [(image * weight).sum() for image, weight in zip(images, v, strict=True)]
    ).sum()


def found(params, scene, v):
    _, saved = render_forward(params, scene.camera, scene.pose)
    return pose_vjp(params, render_vjp(saved, *v), scene.pose)


@pytest.mark.parametrize("degree", [0, 3])
def test_equals_autograd_through_the_stages(scene, generator, degree):
    params = scene.random_map(generator, 40, degree=degree, opacity=(0.3, 0.999))
    v = images_vjp(generator, scene.camera)
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    pose = scene.pose @ se3.exp(xi)
    p = project_gaussians(params, scene.camera, pose)
    rgb = sh_to_rgb(params.sh, params.xyz_W, pose[:3, 3])
    image = composite(
        p.uv,
        p.conic,
        p.opacity,
        rgb,
        p.depth_m,
        tiles_of(p, scene.camera),
        scene.camera,
    )
    (expected,) = torch.autograd.grad(weighted((image.rgb, image.depth_m, image.alpha), v), xi)
    torch.testing.assert_close(
        found(params, scene, v),
        expected,
        atol=1e-8,
        rtol=1e-8,
    )


@pytest.mark.parametrize("degree", [0, 1])
def test_equals_central_differences_of_the_whole_picture(scene, generator, degree):
    params = scene.random_map(generator, 12, degree=degree)
    v = images_vjp(generator, scene.camera)
    h = 1e-6

    def loss(xi):
        out = render(params, scene.camera, scene.pose @ se3.exp(xi))
        return weighted((out.rgb, out.depth_m, out.alpha), v)

    steps = h * torch.eye(6, dtype=torch.float64)
    expected = torch.stack([(loss(step) - loss(-step)) / (2 * h) for step in steps])
    torch.testing.assert_close(
        found(params, scene, v),
        expected,
        atol=1e-4,
        rtol=1e-5,
    )


def rigid_ways(scene):
    """Ways to compute a pose near that of the scene from a leaf: twists on either side, the
    inverse, a quaternion."""
    w = torch.tensor([0.9, 0.2, -0.3, 0.1], dtype=torch.float64)
    xyz = torch.zeros(3, dtype=torch.float64)
    turn = se3.inverse(se3_of(w, xyz)) @ scene.pose
    zero = torch.zeros(6, dtype=torch.float64)
    return {
        "T_WC exp(xi)": (zero, lambda xi: scene.pose @ se3.exp(xi)),
        "exp(xi) T_WC": (zero, lambda xi: se3.exp(xi) @ scene.pose),
        "inverse of T_CW": (zero, lambda xi: se3.inverse(se3.exp(xi) @ se3.inverse(scene.pose))),
        "quaternion and centre": (torch.cat([w, xyz]), lambda x: se3_of(x[:4], x[4:]) @ turn),
    }


def se3_of(quat, t):
    top = torch.cat([quaternion.to_matrix(quat), t[:, None]], dim=1)
    return torch.cat([top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])])


@pytest.mark.parametrize(
    "way", ["T_WC exp(xi)", "exp(xi) T_WC", "inverse of T_CW", "quaternion and centre"]
)
def test_autograd_reaches_a_pose_however_it_is_computed(scene, generator, way):
    """float64 gradcheck: central differences along rigid motions, of the picture, its depth and its
    alpha."""
    params = scene.random_map(generator, 12, degree=1)
    v = images_vjp(generator, scene.camera)
    start, pose_of = rigid_ways(scene)[way]

    def loss(x):
        out = render_autograd(params, scene.camera, pose_of(x))
        return weighted((out.rgb, out.depth_m, out.alpha), v)

    leaf = start.clone().requires_grad_()
    assert torch.autograd.gradcheck(loss, leaf, eps=1e-6, atol=1e-4, rtol=1e-5)


def test_the_gradient_of_the_matrix_has_no_part_that_bends_it(scene, generator):
    params = scene.random_map(generator, 12)
    v = images_vjp(generator, scene.camera)
    T_WC = scene.pose.clone().requires_grad_()
    out = render_autograd(params, scene.camera, T_WC)
    weighted((out.rgb, out.depth_m, out.alpha), v).backward()
    assert T_WC.grad is not None
    turned = scene.pose[:3, :3].T @ T_WC.grad[:3, :3]
    torch.testing.assert_close(turned, -turned.T)
    assert (T_WC.grad[3] == 0).all()
    assert not render_autograd(params, scene.camera, scene.pose).rgb.requires_grad


def test_numba_gives_the_pose_the_same_gradient(scene, generator):
    """In float32, which is what "numba" computes in; relative to the largest of the six numbers."""
    params = scene.random_map(generator, 30, degree=1, dtype=torch.float32)
    v = images_vjp(generator, scene.camera)
    v = [image.float() for image in v]

    def gradient():
        xi = torch.zeros(6, requires_grad=True)
        out = render_autograd(
            params,
            scene.camera,
            scene.pose.float() @ se3.exp(xi),
        )
        return torch.autograd.grad(weighted((out.rgb, out.depth_m, out.alpha), v), xi)[0]

    with use_backend("reference"):
        expected = gradient()
    with use_backend("numba"):
        found = gradient()
    assert float((found - expected).abs().max() / expected.abs().max()) < 1e-4


def test_a_second_derivative_is_refused(scene, generator):
    params = scene.random_map(generator, 5)
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    out = render_autograd(params, scene.camera, scene.pose @ se3.exp(xi))
    with pytest.raises(RuntimeError, match="create_graph"):
        torch.autograd.grad(out.rgb.square().sum(), xi, create_graph=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_gaussians(scene, generator, dtype):
    p = project_gaussians(
        scene.random_map(generator, 0, dtype=dtype),
        scene.camera,
        scene.pose,
    )
    assert p.uv.shape == (0, 2)
    assert p.uv.dtype == dtype


def test_is_zero_without_gaussians(scene, generator):
    params = scene.random_map(generator, 0)
    v = images_vjp(generator, scene.camera)
    assert torch.equal(found(params, scene, v), torch.zeros(6, dtype=torch.float64))
