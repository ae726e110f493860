"""The gradient to the camera's pose, checked against autograd through the stages and against central differences."""

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.geometry import quaternion, se3
from gsfusion_nb.geometry.spherical_harmonics import sh_to_rgb
from gsfusion_nb.render import (
    composite,
    pose_vjp,
    project_gaussians,
    render,
    render_autograd,
    render_forward,
    render_vjp,
)
from gsfusion_nb.render import tile_intersections as tiles_of


def images_vjp(generator, camera):
    v = torch.randn(5, camera.height, camera.width, generator=generator, dtype=torch.float64)
    return v[:3].permute(1, 2, 0), v[3], v[4]


def weighted(images, v):
    return torch.stack([(image * weight).sum() for image, weight in zip(images, v, strict=True)]).sum()


def found(params, scene, v):
    _, saved = render_forward(params, scene.camera, scene.pose)
    return pose_vjp(params, render_vjp(saved, *v), scene.pose)


@pytest.mark.parametrize("degree", [0, 3])
def test_equals_autograd_through_the_stages(scene, generator, degree):
    params, v = (
        scene.random_map(generator, 40, degree=degree, opacity=(0.3, 0.999)),
        images_vjp(generator, scene.camera),
    )
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    pose = scene.pose @ se3.exp(xi)
    p = project_gaussians(params, scene.camera, pose)
    rgb = sh_to_rgb(params.sh, params.xyz_W, pose[:3, 3])
    image = composite(p.uv, p.conic, p.opacity, rgb, p.depth_m, tiles_of(p, scene.camera), scene.camera)
    (expected,) = torch.autograd.grad(weighted((image.rgb, image.depth_m, image.alpha), v), xi)
    torch.testing.assert_close(found(params, scene, v), expected, atol=1e-8, rtol=1e-8)


@pytest.mark.parametrize("degree", [0, 1])
def test_equals_central_differences_of_the_whole_picture(scene, generator, degree):
    params, v, h = scene.random_map(generator, 12, degree=degree), images_vjp(generator, scene.camera), 1e-6

    def loss(xi):
        out = render(params, scene.camera, scene.pose @ se3.exp(xi))
        return weighted((out.rgb, out.depth_m, out.alpha), v)

    steps = h * torch.eye(6, dtype=torch.float64)
    expected = torch.stack([(loss(step) - loss(-step)) / (2 * h) for step in steps])
    torch.testing.assert_close(found(params, scene, v), expected, atol=1e-4, rtol=1e-5)


def test_is_zero_without_gaussians(scene, generator):
    params, v = scene.random_map(generator, 0), images_vjp(generator, scene.camera)
    assert torch.equal(found(params, scene, v), torch.zeros(6, dtype=torch.float64))


def rigid_ways(scene):
    """Ways to compute a pose near that of the scene from a leaf: twists on either side, the inverse, a quaternion."""
    w, xyz = torch.tensor([0.9, 0.2, -0.3, 0.1], dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
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


@pytest.mark.parametrize("way", ["T_WC exp(xi)", "exp(xi) T_WC", "inverse of T_CW", "quaternion and centre"])
def test_autograd_reaches_a_pose_however_it_is_computed(scene, generator, way):
    """float64 gradcheck: central differences along rigid motions, of the picture, its depth and its alpha."""
    params, v = scene.random_map(generator, 12, degree=1), images_vjp(generator, scene.camera)
    start, pose_of = rigid_ways(scene)[way]

    def loss(x):
        out = render_autograd(params, scene.camera, pose_of(x))
        return weighted((out.rgb, out.depth_m, out.alpha), v)

    leaf = start.clone().requires_grad_()
    assert torch.autograd.gradcheck(loss, leaf, eps=1e-6, atol=1e-4, rtol=1e-5)


def test_the_gradient_of_the_matrix_has_no_part_that_bends_it(scene, generator):
    params, v = scene.random_map(generator, 12), images_vjp(generator, scene.camera)
    T_WC = scene.pose.clone().requires_grad_()
    out = render_autograd(params, scene.camera, T_WC)
    weighted((out.rgb, out.depth_m, out.alpha), v).backward()
    assert T_WC.grad is not None
    turned = scene.pose[:3, :3].T @ T_WC.grad[:3, :3]
    torch.testing.assert_close(turned, -turned.T)
    assert (T_WC.grad[3] == 0).all()
    assert not render_autograd(params, scene.camera, scene.pose).rgb.requires_grad


@pytest.mark.parametrize("backend", ["numba", "torch"])
def test_fast_backends_give_the_pose_the_same_gradient(scene, generator, backend):
    """In float32, which is what "numba" computes in; relative to the largest of the six numbers."""
    params, v = scene.random_map(generator, 30, degree=1, dtype=torch.float32), images_vjp(generator, scene.camera)
    v = [image.float() for image in v]

    def gradient():
        xi = torch.zeros(6, requires_grad=True)
        out = render_autograd(params, scene.camera, scene.pose.float() @ se3.exp(xi))
        return torch.autograd.grad(weighted((out.rgb, out.depth_m, out.alpha), v), xi)[0]

    expected = gradient()
    with use_backend(backend):
        found = gradient()
    assert float((found - expected).abs().max() / expected.abs().max()) < 1e-4


def test_a_second_derivative_is_refused(scene, generator):
    params = scene.random_map(generator, 5)
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    out = render_autograd(params, scene.camera, scene.pose @ se3.exp(xi))
    with pytest.raises(RuntimeError, match="create_graph"):
        torch.autograd.grad(out.rgb.square().sum(), xi, create_graph=True)
