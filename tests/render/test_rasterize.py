import dataclasses
from itertools import product

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.geometry.spherical_harmonics import sh_to_rgb
from gsfusion_nb.render import (
    composite,
    project_gaussians,
    render,
    render_autograd,
    render_forward,
    render_vjp,
    tile_intersections,
)
from gsfusion_nb.types import Camera, GaussianParams

IMAGES = ("rgb", "depth_m", "alpha", "first_index", "dominant_index")


def columns(params):
    return [getattr(params, f.name) for f in dataclasses.fields(GaussianParams)]


def rows(scene, values):
    return GaussianParams(**dict(zip(scene.columns, values, strict=True)))


def cotangents(generator, camera, dtype=torch.float64):
    v = torch.randn(
        5,
        camera.height,
        camera.width,
        generator=generator,
        dtype=torch.float64,
    ).to(dtype)
    return v[:3].permute(1, 2, 0), v[3], v[4]


@pytest.mark.parametrize("degree", [0, 3])
def test_is_its_stages_and_the_gradient_is_their_autograd(scene, generator, degree):
    params = scene.random_map(generator, 50, degree=degree, opacity=(0.3, 0.999))
    leaves = GaussianParams(
        **{n: getattr(params, n).clone().requires_grad_() for n in scene.columns}
    )
    p = project_gaussians(leaves, scene.camera, scene.pose)
    rgb = sh_to_rgb(leaves.sh, leaves.xyz_W, scene.pose[:3, 3])
    image = composite(
        p.uv,
        p.conic,
        p.opacity,
        rgb,
        p.depth_m,
        tile_intersections(p, scene.camera),
        scene.camera,
    )
    out, saved = render_forward(params, scene.camera, scene.pose)
    for name in IMAGES:
        torch.testing.assert_close(getattr(out, name), getattr(image, name).detach())
    v = cotangents(generator, scene.camera)
    loss = (image.rgb * v[0]).sum() + (image.depth_m * v[1]).sum() + (image.alpha * v[2]).sum()
    *expected, expected_uv = torch.autograd.grad(loss, [*columns(leaves), p.uv])
    v_uv = torch.full((50, 2), torch.nan, dtype=torch.float64)
    for name, g, e in zip(
        scene.columns, columns(render_vjp(saved, *v, v_uv=v_uv)), expected, strict=True
    ):
        torch.testing.assert_close(
            g, e, atol=1e-9, rtol=1e-8, msg=lambda m, name=name: f"{name}: {m}"
        )
    torch.testing.assert_close(v_uv, expected_uv, atol=1e-9, rtol=1e-8)


def test_centres_in_the_image_by_moving_the_principal_point(scene, generator):
    """A shift of cx moves every centre by as much: dL/dcx is the sum of dL/du of all Gaussians; by
    differences."""
    params = scene.random_map(generator, 20, degree=1)
    v = cotangents(generator, scene.camera)

    def loss(**shifted):
        out = render(params, dataclasses.replace(scene.camera, **shifted), scene.pose)
        return float(
            sum((x * y).sum() for x, y in zip((out.rgb, out.depth_m, out.alpha), v, strict=True))
        )

    v_uv = torch.empty(20, 2, dtype=torch.float64)
    h = 1e-6
    _, saved = render_forward(params, scene.camera, scene.pose)
    render_vjp(saved, *v, v_uv=v_uv)
    for name, found in zip(
        ("cx", "cy"),
        v_uv.sum(0).tolist(),
        strict=True,
    ):
        at = getattr(scene.camera, name)
        assert found == pytest.approx(
            (loss(**{name: at + h}) - loss(**{name: at - h})) / (2 * h),
            rel=1e-5,
        )
    some = torch.empty(20, 2, dtype=torch.float64)
    rows_ = torch.arange(20) % 3 == 0
    render_vjp(saved, *v, rows=rows_, v_uv=some)
    assert torch.equal(some, torch.where(rows_[:, None], v_uv, 0.0))


def test_absolute_gradients_of_centres_are_those_of_the_single_pixels(scene, generator):
    """And to ask for them changes no other gradient."""
    params = scene.random_map(generator, 20, degree=1)
    v = cotangents(generator, scene.camera)
    rows_ = torch.arange(20) % 3 > 0
    _, saved = render_forward(params, scene.camera, scene.pose)
    total, v_uv, v_uv_abs = (
        torch.zeros(20, 2, dtype=torch.float64),
        *torch.empty(2, 20, 2, dtype=torch.float64),
    )
    for y, x in product(range(4, 9), range(10, 15)):
        one = [torch.zeros_like(image) for image in v]
        for single, image in zip(one, v, strict=True):
            single[y, x] = image[y, x]
        render_vjp(saved, *one, rows=rows_, v_uv=v_uv)
        total += v_uv.abs()
    inside = torch.zeros(scene.camera.height, scene.camera.width, dtype=torch.float64)
    inside[4:9, 10:15] = 1.0
    v = v[0] * inside[..., None], v[1] * inside, v[2] * inside
    asked = render_vjp(saved, *v, rows=rows_, v_uv_abs=v_uv_abs)
    torch.testing.assert_close(v_uv_abs, total, atol=1e-12, rtol=1e-9)
    assert total[rows_].any()
    assert not v_uv_abs[~rows_].any()
    for name, g, e in zip(
        scene.columns,
        columns(asked),
        columns(render_vjp(saved, *v, rows=rows_)),
        strict=True,
    ):
        assert torch.equal(g, e), name


@pytest.mark.parametrize(("degree", "n"), [(0, 5), (3, 2)])
def test_every_parameter_by_finite_differences(scene, generator, degree, n):
    params = scene.random_map(generator, n, degree=degree, scale=0.3)
    camera = Camera(
        width=9,
        height=7,
        fx=10.0,
        fy=10.0,
        cx=4.4,
        cy=3.6,
    )

    def forward(*x):
        out, _ = render_forward(rows(scene, x), camera, scene.pose)
        return out.rgb, out.depth_m, out.alpha

    def vjp(x, *v):
        return tuple(columns(render_vjp(render_forward(rows(scene, x), camera, scene.pose)[1], *v)))

    assert (forward(*columns(params))[2] > 0.3).any()
    scene.finite_difference_check(forward, vjp, columns(params), generator)


def test_autograd_binding_gives_the_explicit_gradient(scene, generator):
    params = scene.random_map(generator, 20, degree=1)
    leaves = GaussianParams(
        **{n: getattr(params, n).clone().requires_grad_() for n in scene.columns}
    )
    out = render_autograd(leaves, scene.camera, scene.pose)
    v = cotangents(generator, scene.camera)
    (out.rgb * v[0]).sum().backward()
    explicit = render_vjp(render_forward(params, scene.camera, scene.pose)[1], v[0])
    for leaf, g in zip(columns(leaves), columns(explicit), strict=True):
        torch.testing.assert_close(leaf.grad, g)
    plain = render(leaves, scene.camera, scene.pose)
    assert not plain.rgb.requires_grad
    torch.testing.assert_close(plain.rgb, out.rgb.detach())


@pytest.mark.parametrize("changed", ["xyz_W", "log_scale", "quat", "opacity_logit", "sh", "pose"])
def test_a_change_in_place_before_the_backward_is_refused(scene, generator, changed):
    params = scene.random_map(generator, 5, degree=1)
    leaves = {name: getattr(params, name).clone().requires_grad_() for name in scene.columns}
    pose = scene.pose.clone()
    out = render_autograd(GaussianParams(**leaves), scene.camera, pose)
    with torch.no_grad():
        (pose if changed == "pose" else leaves[changed]).mul_(1.01)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        out.rgb.sum().backward()


@pytest.mark.parametrize("backend", ["reference", "auto"])
@pytest.mark.parametrize("image", ["rgb", "depth_m", "alpha"])
def test_a_picture_changed_in_place_is_refused_too(scene, generator, backend, image):
    """A record may hold the picture itself."""
    params = rows(
        scene,
        [column.float() for column in columns(scene.random_map(generator, 5, degree=1))],
    )
    leaves = GaussianParams(
        **{n: getattr(params, n).clone().requires_grad_() for n in scene.columns}
    )
    with use_backend(backend):
        out = render_autograd(leaves, scene.camera, scene.pose.float())
        with pytest.raises(RuntimeError, match="inplace"):
            getattr(out, image).mul_(2.0).sum().backward()


def test_order_of_rows_does_not_matter(scene, generator):
    params = scene.random_map(generator, 40, degree=1)
    order = torch.randperm(40, generator=generator)
    v = cotangents(generator, scene.camera)
    out, saved = render_forward(params, scene.camera, scene.pose)
    shuffled, saved_shuffled = render_forward(params[order], scene.camera, scene.pose)
    for name in ("rgb", "depth_m", "alpha"):
        torch.testing.assert_close(getattr(shuffled, name), getattr(out, name))
    for name in ("first_index", "dominant_index"):
        index = getattr(shuffled, name)
        assert torch.equal(
            torch.where(index >= 0, order[index], -1),
            getattr(out, name),
        )
    for a, b in zip(
        columns(render_vjp(saved_shuffled, *v)),
        columns(render_vjp(saved, *v)),
        strict=True,
    ):
        torch.testing.assert_close(a, b[order])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [0, 1, 33])
@pytest.mark.parametrize(
    "size",
    [(1, 1), (27, 19), (16, 8), (129, 3)],
)
def test_any_number_of_gaussians_on_any_image(scene, generator, n, size, dtype):
    camera = Camera(
        width=size[0],
        height=size[1],
        fx=30.0,
        fy=30.0,
        cx=size[0] / 2,
        cy=size[1] / 2,
    )
    params = scene.random_map(generator, n, degree=2, dtype=dtype)
    out, saved = render_forward(params, camera, scene.pose.float())
    assert out.rgb.shape == (size[1], size[0], 3)
    assert out.rgb.dtype == dtype
    gradient = render_vjp(saved, *cotangents(generator, camera, dtype))
    for g, x in zip(columns(gradient), columns(params), strict=True):
        assert g.shape == x.shape
        assert g.dtype == dtype
        assert torch.isfinite(g).all()
    if n == 0:
        assert (out.rgb == 0).all()
        assert (out.dominant_index == -1).all()
        assert (out.first_index == -1).all()


def test_depth_and_alpha_gradients_default_to_zero(scene, generator):
    params = scene.random_map(generator, 10)
    _, saved = render_forward(params, scene.camera, scene.pose)
    v_rgb, v_depth, v_alpha = cotangents(generator, scene.camera)
    for a, b in zip(
        columns(render_vjp(saved, v_rgb)),
        columns(render_vjp(saved, v_rgb, 0 * v_depth, 0 * v_alpha)),
        strict=True,
    ):
        assert torch.equal(a, b)


def test_all_behind_the_camera(scene, generator):
    params = scene.random_map(generator, 10)
    turned = scene.pose.clone()
    turned[:3, 0] = -turned[:3, 0]
    turned[:3, 2] = -turned[:3, 2]
    out, saved = render_forward(params, scene.camera, turned)
    assert (out.alpha == 0).all()
    gradient = render_vjp(saved, *cotangents(generator, scene.camera))
    assert all((g == 0).all() for g in columns(gradient))


def test_float32_is_close_to_float64(scene, generator):
    params = scene.random_map(generator, 300, degree=3)
    single = scene.random_map(
        torch.Generator().manual_seed(0),
        300,
        degree=3,
        dtype=torch.float32,
    )
    v = cotangents(generator, scene.camera)
    exact, saved = render_forward(params, scene.camera, scene.pose)
    out, saved_single = render_forward(single, scene.camera, scene.pose)
    # one step of a 1/255 or 1e-4 threshold may differ at a few pixels
    assert (out.rgb.double() - exact.rgb).abs().median() < 1e-6
    assert ((out.rgb.double() - exact.rgb) ** 2).mean() < 1e-8
    gradients = (
        columns(render_vjp(saved_single, *(x.float() for x in v))),
        columns(render_vjp(saved, *v)),
    )
    for a, b in zip(*gradients, strict=True):
        assert (
            torch.cosine_similarity(
                a.double().flatten(),
                b.flatten(),
                dim=0,
            )
            > 0.9999
        )


def test_without_indices(scene, generator):
    params = scene.random_map(generator, 10)
    full, bare = (
        render_forward(params, scene.camera, scene.pose, with_indices=w)[0] for w in (True, False)
    )
    assert torch.equal(full.rgb, bare.rgb)
    assert bare.first_index is None
    assert bare.dominant_index is None
