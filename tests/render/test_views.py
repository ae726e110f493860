"""Several cameras, background, features, near and far planes, intrinsics."""

import dataclasses
import math

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.geometry import se3
from gsfusion_nb.render import render, render_autograd, render_forward
from gsfusion_nb.types import GaussianParams

IMAGES = ("rgb", "depth_m", "alpha", "first_index", "dominant_index")


def features_of(params, scene, features):
    image = render(params, scene.camera, scene.pose, features=features).features
    assert image is not None
    return image


def poses(scene, n=3):
    """Poses beside that of the scene."""
    twists = torch.linspace(-0.1, 0.1, n * 6, dtype=torch.float64).reshape(n, 6)
    return torch.stack([scene.pose @ se3.exp(twist) for twist in twists])


def weighted(images, generator):
    total = torch.zeros((), dtype=torch.float64)
    for image in images:
        weight = torch.randn(image.shape, generator=generator, dtype=torch.float64)
        total = total + (image * weight.to(image)).sum()
    return total


def leaves_of(params):
    return GaussianParams(**{n: x.clone().requires_grad_() for n, x in vars(params).items()})


def test_without_options_it_is_render_forward(scene, generator):
    params = scene.random_map(generator, 30, degree=1)
    ours = render(params, scene.camera, scene.pose)
    plain, _ = render_forward(params, scene.camera, scene.pose)
    for name in IMAGES:
        assert torch.equal(getattr(ours, name), getattr(plain, name))
    assert ours.features is None
    assert not render(leaves_of(params), scene.camera, scene.pose).rgb.requires_grad


@pytest.mark.parametrize("own_cameras", [False, True])
def test_several_cameras_are_their_pictures_and_the_sum_of_their_gradients(
    scene, generator, own_cameras
):
    params = scene.random_map(generator, 30, degree=1)
    features = torch.randn(30, 4, generator=generator, dtype=torch.float64)
    T_WC = poses(scene)
    wide = dataclasses.replace(scene.camera, fx=25.0)
    cameras = [scene.camera, wide, scene.camera] if own_cameras else scene.camera
    background = torch.rand(3, 3, generator=generator, dtype=torch.float64)
    leaves = leaves_of(params)
    together = render_autograd(leaves, cameras, T_WC, background=background, features=features)
    assert together.rgb.shape == (3, scene.camera.height, scene.camera.width, 3)
    assert together.features is not None
    assert together.features.shape[-1] == 4
    weighted(
        [together.rgb, together.depth_m, together.alpha, together.features],
        torch.Generator().manual_seed(3),
    ).backward()
    singly = leaves_of(params)
    pictures = [
        render_autograd(
            singly,
            cameras[i] if own_cameras else scene.camera,
            T_WC[i],
            background=background[i],
            features=features,
        )
        for i in range(3)
    ]
    for name in (*IMAGES, "features"):
        images = [getattr(p, name) for p in pictures]
        assert torch.equal(getattr(together, name), torch.stack(images)), name
    stacked = [
        torch.stack([getattr(p, name) for p in pictures])
        for name in ("rgb", "depth_m", "alpha", "features")
    ]
    weighted(stacked, torch.Generator().manual_seed(3)).backward()
    for name in scene.columns:
        torch.testing.assert_close(getattr(leaves, name).grad, getattr(singly, name).grad)


def test_the_background_is_seen_through_what_is_left(scene, generator):
    params = scene.random_map(generator, 12)
    black = render(params, scene.camera, scene.pose)
    grey = torch.full((3,), 0.5, dtype=torch.float64)
    over_grey = render(params, scene.camera, scene.pose, background=grey)
    torch.testing.assert_close(over_grey.rgb, black.rgb + 0.5 * (1 - black.alpha[..., None]))
    assert torch.equal(over_grey.alpha, black.alpha)
    empty = render(scene.random_map(generator, 0), scene.camera, scene.pose, background=grey)
    assert (empty.rgb == 0.5).all()


def test_features_are_blended_like_colours(scene, generator):
    """Features that are the colours give the picture; below zero and more than three, too."""
    params = scene.random_map(generator, 20)
    colours = (0.5 + 0.28209479177387814 * params.sh[:, 0]).clamp_min(0)
    far_below = colours - 7
    ones = torch.ones(20, 1, dtype=torch.float64)
    out = render(params, scene.camera, scene.pose)
    image = features_of(params, scene, torch.cat([colours, far_below, ones], dim=1))
    torch.testing.assert_close(image[..., :3], out.rgb)
    torch.testing.assert_close(image[..., 3:6], out.rgb - 7 * out.alpha[..., None])
    torch.testing.assert_close(image[..., 6], out.alpha)
    none = torch.zeros(20, 0, dtype=torch.float64)
    assert features_of(params, scene, none).shape[-1] == 0
    nobody = scene.random_map(generator, 0)
    assert not features_of(nobody, scene, torch.zeros(0, 4).double()).any()


def test_what_has_no_colour_has_no_features_either(scene, generator):
    params = scene.random_map(generator, 5)
    params.sh[2] = torch.nan
    ones = torch.ones(5, 1, dtype=torch.float64)
    image = features_of(params, scene, ones)
    torch.testing.assert_close(image[..., 0], render(params, scene.camera, scene.pose).alpha)


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_near_and_far_leave_out_what_is_nearer_and_farther(scene, generator, backend):
    params = scene.random_map(generator, 40, dtype=torch.float32)
    pose = scene.pose.float()
    depth_m = se3.apply(se3.inverse(pose), params.xyz_W)[:, 2]
    within = (depth_m > 1.5) & (depth_m <= 2.5)
    assert 0 < int(within.sum()) < 40
    with use_backend(backend):
        cut = render(params, scene.camera, pose, near_m=1.5, far_m=2.5)
        rest = render(params[within], scene.camera, pose)
        assert torch.equal(cut.rgb, rest.rgb)
        assert torch.equal(cut.depth_m, rest.depth_m)
        # a map and its distance a hundredth as large look the same, if the near plane is, too
        small = dataclasses.replace(
            params,
            xyz_W=(params.xyz_W - pose[:3, 3]) / 100 + pose[:3, 3],
            log_scale=params.log_scale - math.log(100),
        )
        assert not render(small, scene.camera, pose).alpha.any()
        shown = render(small, scene.camera, pose, near_m=0.002).alpha
        torch.testing.assert_close(
            shown, render(params, scene.camera, pose).alpha, atol=1e-3, rtol=1e-3
        )


def with_a_clamped_one(scene, generator):
    """A map with a large Gaussian beside the view, whose x / z is clamped in the Jacobian."""
    params = scene.random_map(generator, 12, degree=1)
    beside = torch.tensor([1.4, -0.9, 2.0], dtype=torch.float64)
    params.xyz_W[0] = se3.apply(scene.pose, beside[None])[0]
    params.log_scale[0] = math.log(0.3)
    return params


def test_intrinsics_background_and_features_by_finite_differences(scene, generator):
    """float64 gradcheck of all images."""
    params = with_a_clamped_one(scene, generator)
    features = torch.randn(12, 4, generator=generator, dtype=torch.float64)
    background = torch.rand(3, generator=generator, dtype=torch.float64)
    numbers = torch.tensor([30.0, 28.0, 12.8, 10.1], dtype=torch.float64)

    def loss(numbers, background, features):
        zero = numbers.new_zeros(())
        fx, fy, cx, cy = numbers
        K = torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, zero + 1]).reshape(3, 3)
        out = render_autograd(
            params, scene.camera, scene.pose, K=K, background=background, features=features
        )
        images = [out.rgb, out.depth_m, out.alpha, out.features]
        return weighted(images, torch.Generator().manual_seed(5))

    leaves = [x.clone().requires_grad_() for x in (numbers, background, features)]
    assert torch.autograd.gradcheck(loss, leaves, eps=1e-6, atol=1e-4, rtol=1e-5)


def test_parameters_through_background_and_features_by_finite_differences(scene, generator):
    params = scene.random_map(generator, 3)
    features = torch.randn(3, 4, generator=generator, dtype=torch.float64)
    background = torch.rand(3, generator=generator, dtype=torch.float64)

    def loss(*columns):
        out = render_autograd(
            GaussianParams(**dict(zip(scene.columns, columns, strict=True))),
            scene.camera,
            scene.pose,
            background=background,
            features=features,
            near_m=0.01,
        )
        return weighted([out.rgb, out.alpha, out.features], torch.Generator().manual_seed(5))

    leaves = [getattr(params, name).clone().requires_grad_() for name in scene.columns]
    assert torch.autograd.gradcheck(loss, leaves, eps=1e-6, atol=1e-5, rtol=1e-5)


def test_numba_gives_the_intrinsics_the_same_gradient(scene, generator):
    params = scene.random_map(generator, 30, degree=1, dtype=torch.float32)
    K = scene.camera.K.float()

    def gradient():
        leaf = K.clone().requires_grad_()
        out = render_autograd(params, scene.camera, scene.pose.float(), K=leaf)
        loss = weighted([out.rgb, out.depth_m, out.alpha], torch.Generator().manual_seed(5))
        return torch.autograd.grad(loss, leaf)[0]

    expected = gradient()
    with use_backend("numba"):
        found = gradient()
    assert (expected[[0, 1, 0, 1], [0, 1, 2, 2]] != 0).all()
    assert int((expected != 0).sum()) == 4
    assert float((found - expected).abs().max() / expected.abs().max()) < 1e-4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"K": torch.eye(2)}, r"K must be \[3, 3\]"),
        ({"K": torch.tensor([[9.0, 1, 3], [0, 9, 3], [0, 0, 1]])}, "without a skew"),
        ({"background": torch.zeros(4)}, r"background must be \[3\]"),
        ({"background": torch.zeros(3)}, "background must be torch.float64"),
        ({"features": torch.zeros(4, 2).double()}, r"features must be \[5, F\], got \[4, 2\]"),
        ({"features": torch.full((5, 2), torch.inf).double()}, "features must be finite"),
        ({"near_m": 0.0}, "near_m must be > 0"),
        ({"near_m": 1.0, "far_m": 0.5}, "far_m must be >= 1"),
    ],
)
def test_wrong_options_are_named(scene, generator, changes, message):
    params = scene.random_map(generator, 5)
    with pytest.raises(ValueError, match=message):
        render_autograd(params, scene.camera, scene.pose, **changes)


def test_wrong_numbers_of_cameras_are_named(scene, generator):
    params = scene.random_map(generator, 5)
    small = scene.camera.resized(8, 6)
    with pytest.raises(ValueError, match="same image size, got 8 x 6 and 27 x 19"):
        render(params, [scene.camera, small], poses(scene, 2))
    with pytest.raises(ValueError, match="got 2 cameras and 3 poses"):
        render(params, [scene.camera, scene.camera], poses(scene))
    with pytest.raises(ValueError, match="background must be one for all pictures, or 3, got 4"):
        render(params, scene.camera, poses(scene), background=torch.zeros(4, 3).double())
    with pytest.raises(ValueError, match="K must be one for all pictures, or 3, got 2"):
        render_autograd(params, scene.camera, poses(scene), K=torch.zeros(2, 3, 3))
    with pytest.raises(ValueError, match="a pose for each"):
        render(params, [scene.camera], scene.pose)
    with pytest.raises(ValueError, match="at least one; got 0 cameras and 0 poses"):
        render(params, scene.camera, torch.zeros(0, 4, 4))
