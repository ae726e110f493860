import dataclasses

import pytest
import torch

from gsfusion_nb.render import (
    Projection,
    composite,
    composite_vjp,
    project_gaussians,
    tile_intersections,
)
from gsfusion_nb.types import Camera

NAMES = ("uv", "conic", "opacity", "rgb", "depth_m")


def screen(scene, generator, n, **kwargs):
    """Projection and colours of a random map."""
    projection = project_gaussians(
        scene.random_map(generator, n, **kwargs), scene.camera, scene.pose
    )
    return projection, torch.rand(n, 3, generator=generator, dtype=torch.float64)


def splats(projection, rgb):
    return projection.uv, projection.conic, projection.opacity, rgb, projection.depth_m


def one_splat(opacity):
    camera = Camera(
        width=12,
        height=1,
        fx=1.0,
        fy=1.0,
        cx=0.0,
        cy=0.0,
    )
    row = torch.tensor([[0.5, 0.5]], dtype=torch.float64)
    variance = 9.3
    conic = torch.tensor([[1 / variance, 0, 1 / variance]], dtype=torch.float64)
    o = torch.tensor([opacity], dtype=torch.float64)
    reach = (2 * (255 * o).log() * variance).sqrt()
    return camera, Projection(
        uv=row,
        conic=conic,
        depth_m=2 + 0 * o,
        opacity=o,
        extent_px=reach.expand(1, 2),
        visible=torch.ones(1, dtype=torch.bool),
    )


def test_alpha_of_one_gaussian_by_hand():
    camera, projection = one_splat(0.5)
    rgb = torch.tensor([[1.0, 0.5, 0]], dtype=torch.float64)
    image = composite(*splats(projection, rgb), tile_intersections(projection, camera), camera)
    expected = torch.tensor([0.5, 0.473828, 0.403249, 0.308196, 0.130389], dtype=torch.float64)
    at = [0, 1, 2, 3, 5]
    torch.testing.assert_close(
        image.alpha[0, at],
        expected,
        atol=5e-7,
        rtol=0,
    )
    torch.testing.assert_close(
        image.rgb[0, at],
        expected[:, None] * rgb,
        atol=1e-6,
        rtol=0,
    )
    torch.testing.assert_close(
        image.depth_m[0, at],
        2 * expected,
        atol=1e-6,
        rtol=0,
    )
    # sigma = ln(127.5) at 9.496 px: pixel 9 is drawn, pixel 10 is not
    assert (image.first_index[0] == torch.tensor([0] * 10 + [-1] * 2)).all()
    assert (image.dominant_index == image.first_index).all()
    assert (image.alpha[0, 10:] == 0).all()


def test_three_flat_layers_by_hand():
    camera, projection = one_splat(0.5)
    flat = torch.tensor([[1e-9, 0, 1e-9]], dtype=torch.float64)
    rows = torch.zeros(4, dtype=torch.long)
    z = torch.tensor([3.0, 1.0, 2.0, 4.0], dtype=torch.float64)
    o = torch.tensor([0.8, 0.3, 1.0, 0.9], dtype=torch.float64)
    four = dataclasses.replace(
        projection,
        uv=projection.uv[rows],
        conic=flat[rows],
        depth_m=z,
        opacity=o,
        extent_px=torch.full((4, 2), 1e5, dtype=torch.float64),
        visible=torch.ones(4, dtype=torch.bool),
    )
    rgb = torch.eye(4, 3, dtype=torch.float64)
    image = composite(*splats(four, rgb), tile_intersections(four, camera), camera)
    # order 1, 2, 0, 3; alpha of row 2 is clamped to 0.99; T = 1, 0.7, 0.007, 0.0014, 0.00014
    w = {1: 0.3, 2: 0.7 * 0.99, 0: 0.007 * 0.8, 3: 0.0014 * 0.9}
    torch.testing.assert_close(
        image.rgb[0, 3],
        torch.tensor([w[0], w[1], w[2]], dtype=torch.float64),
    )
    torch.testing.assert_close(image.alpha[0, 3].item(), sum(w.values()))
    torch.testing.assert_close(
        image.depth_m[0, 3].item(),
        sum(w[n] * z[n].item() for n in w),
    )
    assert image.first_index[0, 3] == 1
    assert image.dominant_index[0, 3] == 2
    # with row 0 at 0.99 too, T would fall to 7e-5 after it: the pixel stops before it
    darker = dataclasses.replace(
        four, opacity=torch.tensor([0.99, 0.3, 1.0, 0.9], dtype=torch.float64)
    )
    image = composite(*splats(darker, rgb), tile_intersections(darker, camera), camera)
    torch.testing.assert_close(
        image.alpha[0, 3].item(),
        w[1] + w[2],
    )


def blobs(*rows):
    """A projection and colours of round Gaussians, one of (u, v, variance, depth, opacity, rgb)
    each."""
    u, v, variance, z, o, rgb = (
        torch.tensor(column, dtype=torch.float64) for column in zip(*rows, strict=True)
    )
    projection = Projection(
        uv=torch.stack([u, v], dim=1),
        conic=torch.stack([1 / variance, 0 * variance, 1 / variance], dim=1),
        depth_m=z,
        opacity=o,
        extent_px=(2 * (255 * o).log() * variance).sqrt()[:, None].expand(-1, 2),
        visible=torch.ones(len(rows), dtype=torch.bool),
    )
    return projection, rgb


def test_three_gaussians_at_every_pixel():
    """Kerbl Eq. 3 written out for three: C = c1 a1 + c2 a2 (1 - a1) + c3 a3 (1 - a1)(1 - a2),
    nearest first."""
    camera = Camera(
        width=13,
        height=9,
        fx=1.0,
        fy=1.0,
        cx=0.0,
        cy=0.0,
    )
    near = (3.0, 4.0, 1.0, 1.0, 0.6, (1.0, 0.2, 0.0))
    middle = (5.5, 2.5, 2.0, 2.0, 0.9, (0.0, 1.0, 0.3))
    far = (8.5, 6.0, 1.5, 3.0, 0.8, (0.4, 0.0, 1.0))
    projection, rgb = blobs(far, near, middle)
    image = composite(*splats(projection, rgb), tile_intersections(projection, camera), camera)
    y, x = torch.meshgrid(
        torch.arange(9).double() + 0.5,
        torch.arange(13).double() + 0.5,
        indexing="ij",
    )

    def alpha(u, v, variance, z, o, c):
        a = o * torch.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * variance))
        return torch.where(a >= 1 / 255, a, 0.0)

    a1, a2, a3 = (alpha(*row) for row in (near, middle, far))
    w1 = a1
    w2 = a2 * (1 - a1)
    w3 = a3 * (1 - a1) * (1 - a2)
    colours = torch.tensor(
        [near[5], middle[5], far[5]],
        dtype=torch.float64,
    )
    torch.testing.assert_close(
        image.rgb,
        torch.stack([w1, w2, w3], dim=-1) @ colours,
    )
    torch.testing.assert_close(image.depth_m, w1 * 1.0 + w2 * 2.0 + w3 * 3.0)
    torch.testing.assert_close(
        image.alpha,
        1 - (1 - a1) * (1 - a2) * (1 - a3),
    )
    drawn = image.alpha > 0
    heaviest = torch.tensor([1, 2, 0])[torch.stack([w1, w2, w3]).argmax(0)]
    assert torch.equal(image.dominant_index, torch.where(drawn, heaviest, -1))
    first = torch.where(
        a1 > 0,
        1,
        torch.where(a2 > 0, 2, torch.where(a3 > 0, 0, -1)),
    )
    assert torch.equal(image.first_index, first)
    assert len(first.unique()) == 4
    assert len(heaviest[drawn].unique()) == 3


def test_equal_layers_and_where_they_stop():
    """n layers of alpha 1/2 leave 2^-n of the light; the 14th would leave 6e-5, below 1e-4, and is
    not blended."""
    camera = Camera(
        width=1,
        height=1,
        fx=1.0,
        fy=1.0,
        cx=0.0,
        cy=0.0,
    )
    for n in (1, 2, 13, 14, 20):
        projection, rgb = blobs(*((0.5, 0.5, 1e6, 1.0 + i, 0.5, (1.0, 0.5, 0.0)) for i in range(n)))
        image = composite(*splats(projection, rgb), tile_intersections(projection, camera), camera)
        torch.testing.assert_close(
            image.alpha[0, 0].item(),
            1 - 0.5 ** min(n, 13),
        )
        torch.testing.assert_close(
            image.rgb[0, 0],
            (1 - 0.5 ** min(n, 13)) * rgb[0],
        )


def test_gradient_of_two_layers_by_hand():
    """C = c1 a1 + c2 a2 (1 - a1), so dC/da1 = c1 - c2 a2, dC/da2 = c2 (1 - a1), dC/dc1 = a1, dC/dc2
    = a2 (1 - a1)."""
    camera = Camera(
        width=1,
        height=1,
        fx=1.0,
        fy=1.0,
        cx=0.0,
        cy=0.0,
    )
    projection, rgb = blobs(
        (0.5, 0.5, 1e6, 1.0, 0.4, (0.9, 0, 0)),
        (0.5, 0.5, 1e6, 2.0, 0.7, (0.5, 0, 0)),
    )
    image = composite(*splats(projection, rgb), tile_intersections(projection, camera), camera)
    v = torch.tensor([[[1.0, 0, 0]]], dtype=torch.float64)
    g = composite_vjp(image.saved, v)
    torch.testing.assert_close(g.opacity, rgb.new_tensor([0.9 - 0.5 * 0.7, 0.5 * 0.6]))
    torch.testing.assert_close(g.rgb[:, 0], rgb.new_tensor([0.4, 0.7 * 0.6]))
    assert not g.uv.any()  # the pixel centre is the centre of both
    # with alpha clamped at 0.99 in front, nothing reaches its opacity
    clamped = dataclasses.replace(projection, opacity=rgb.new_tensor([0.995, 0.7]))
    image = composite(*splats(clamped, rgb), tile_intersections(clamped, camera), camera)
    torch.testing.assert_close(
        composite_vjp(image.saved, v).opacity, rgb.new_tensor([0.0, 0.5 * 0.01])
    )


KINDS = {
    "thin": {"opacity": (0.05, 0.4)},
    "usual": {},
    "opaque": {"opacity": (0.7, 0.9999), "scale": 0.5},
    "tiny": {"scale": 0.004},
}


@pytest.mark.parametrize("kind", KINDS)
def test_gradient_is_the_autograd_of_the_forward(scene, generator, kind):
    projection, rgb = screen(scene, generator, 40, **KINDS[kind])
    leaves = [x.detach().clone().requires_grad_() for x in splats(projection, rgb)]
    image = composite(*leaves, tile_intersections(projection, scene.camera), scene.camera)
    if kind == "opaque":
        assert (projection.opacity > 0.99).any()
        assert (image.alpha > 0.999).any(), "some pixels should stop in this test"
    v_rgb, v_depth, v_alpha = torch.randn(
        5, 19, 27, generator=generator, dtype=torch.float64
    ).split([3, 1, 1])
    v_rgb = v_rgb.permute(1, 2, 0)
    v_depth = v_depth[0]
    v_alpha = v_alpha[0]
    loss = (
        (image.rgb * v_rgb).sum() + (image.depth_m * v_depth).sum() + (image.alpha * v_alpha).sum()
    )
    expected = torch.autograd.grad(loss, leaves)
    with torch.no_grad():
        found = composite_vjp(image.saved, v_rgb, v_depth, v_alpha)
    for name, e in zip(NAMES, expected, strict=True):
        torch.testing.assert_close(
            getattr(found, name),
            e,
            atol=1e-9,
            rtol=1e-9,
            msg=lambda m, name=name: f"{name}: {m}",
        )


def test_absolute_gradients_of_the_centres_by_autograd_of_each_pixel(scene, generator):
    """With alphas cut at 0.99, pixels that stop early, and a Gaussian whose pixels pull it to
    opposite sides."""
    projection, rgb = screen(scene, generator, 12, opacity=(0.7, 0.9999), scale=0.5)
    camera = Camera(
        width=9,
        height=7,
        fx=1.0,
        fy=1.0,
        cx=1.0,
        cy=1.0,
    )
    near = dataclasses.replace(projection, uv=projection.uv * 0.35)
    leaves = [x.detach().clone().requires_grad_() for x in splats(near, rgb)]
    lists = tile_intersections(near, camera, tile_px=4)
    v = torch.randn(7, 9, 5, generator=generator, dtype=torch.float64)
    image = composite(*leaves, lists, camera)
    loss = (
        torch.cat(
            [image.rgb, image.depth_m[..., None], image.alpha[..., None]],
            dim=-1,
        )
        * v
    ).sum(-1)
    by_pixel = [
        torch.autograd.grad(pixel, leaves[0], retain_graph=True)[0] for pixel in loss.flatten()
    ]
    with torch.no_grad():
        saved = composite(*(x.detach() for x in leaves), lists, camera).saved
        found = composite_vjp(
            saved,
            v[..., :3],
            v[..., 3],
            v[..., 4],
            with_uv_abs=True,
        )
        assert composite_vjp(saved, v[..., :3]).uv_abs is None
    expected = torch.stack(by_pixel).abs().sum(0)
    torch.testing.assert_close(found.uv_abs, expected, atol=1e-12, rtol=1e-9)
    torch.testing.assert_close(
        found.uv,
        torch.stack(by_pixel).sum(0),
        atol=1e-12,
        rtol=1e-9,
    )
    assert (expected > 10 * found.uv.abs()).any()


def test_vjp_by_finite_differences(scene, generator):
    projection, rgb = screen(scene, generator, 6)
    camera = Camera(
        width=9,
        height=7,
        fx=1.0,
        fy=1.0,
        cx=1.0,
        cy=1.0,
    )
    near = dataclasses.replace(projection, uv=projection.uv * 0.35)
    lists = tile_intersections(near, camera)
    assert len(lists.gaussian) > 6

    def forward(*x):
        image = composite(*x, lists, camera)
        return image.rgb, image.depth_m, image.alpha

    def vjp(x, *v):
        g = composite_vjp(composite(*x, lists, camera).saved, *v)
        return tuple(getattr(g, name) for name in NAMES)

    scene.finite_difference_check(forward, vjp, splats(near, rgb), generator)


@pytest.mark.parametrize("tile_px", [1, 3, 4, 16, 32])
def test_does_not_depend_on_the_tile_size(scene, generator, tile_px):
    projection, rgb = screen(scene, generator, 50, opacity=(0.3, 0.999))
    v = torch.randn(19, 27, 3, generator=generator, dtype=torch.float64)
    usual = composite(
        *splats(projection, rgb), tile_intersections(projection, scene.camera), scene.camera
    )
    other = composite(
        *splats(projection, rgb),
        tile_intersections(projection, scene.camera, tile_px=tile_px),
        scene.camera,
    )
    for name in ("rgb", "depth_m", "alpha", "first_index", "dominant_index"):
        torch.testing.assert_close(getattr(other, name), getattr(usual, name))
    g_usual = composite_vjp(usual.saved, v)
    g_other = composite_vjp(other.saved, v)
    for name in NAMES:
        torch.testing.assert_close(
            getattr(g_other, name), getattr(g_usual, name), atol=1e-10, rtol=1e-9
        )


def test_inputs_are_left_alone(scene, generator):
    projection, rgb = screen(scene, generator, 20)
    before = [x.clone() for x in splats(projection, rgb)]
    image = composite(
        *splats(projection, rgb), tile_intersections(projection, scene.camera), scene.camera
    )
    v = torch.ones(19, 27, 3, dtype=torch.float64)
    first = composite_vjp(image.saved, v)
    second = composite_vjp(image.saved, v)
    for name in NAMES:
        assert torch.equal(getattr(first, name), getattr(second, name)), (
            "the gradient can be asked for twice"
        )
    for x, b in zip(splats(projection, rgb), before, strict=True):
        assert torch.equal(x, b)
