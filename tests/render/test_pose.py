"""The gradient to the camera's pose, checked against autograd through the stages and against central differences."""

import pytest
import torch

from gsfusion_nb.geometry import se3
from gsfusion_nb.geometry.spherical_harmonics import sh_to_rgb
from gsfusion_nb.render import composite, pose_vjp, project_gaussians, render, render_forward, render_vjp
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
