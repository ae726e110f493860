import dataclasses

import pytest
import torch

from gsfusion_nb.render import Projection, chunks, composite, composite_vjp, project_gaussians, tile_intersections
from gsfusion_nb.types import Camera

NAMES = ("uv", "conic", "opacity", "rgb", "depth_m")


def screen(book, generator, n, **kwargs):
    """Projection and colours of a random map."""
    projection = project_gaussians(book.random_map(generator, n, **kwargs), book.camera, book.pose)
    return projection, torch.rand(n, 3, generator=generator, dtype=torch.float64)


def splats(projection, rgb):
    return projection.uv, projection.conic, projection.opacity, rgb, projection.depth_m


def one_splat(opacity):
    camera = Camera(width=12, height=1, fx=1.0, fy=1.0, cx=0.0, cy=0.0)
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
    torch.testing.assert_close(image.alpha[0, at], expected, atol=5e-7, rtol=0)
    torch.testing.assert_close(image.rgb[0, at], expected[:, None] * rgb, atol=1e-6, rtol=0)
    torch.testing.assert_close(image.depth_m[0, at], 2 * expected, atol=1e-6, rtol=0)
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
    torch.testing.assert_close(image.rgb[0, 3], torch.tensor([w[0], w[1], w[2]], dtype=torch.float64))
    torch.testing.assert_close(image.alpha[0, 3].item(), sum(w.values()))
    torch.testing.assert_close(image.depth_m[0, 3].item(), sum(w[n] * z[n].item() for n in w))
    assert image.first_index[0, 3] == 1
    assert image.dominant_index[0, 3] == 2
    # with row 0 at 0.99 too, T would fall to 7e-5 after it: the pixel stops before it
    darker = dataclasses.replace(four, opacity=torch.tensor([0.99, 0.3, 1.0, 0.9], dtype=torch.float64))
    image = composite(*splats(darker, rgb), tile_intersections(darker, camera), camera)
    torch.testing.assert_close(image.alpha[0, 3].item(), w[1] + w[2])


SCENES = {
    "thin": {"opacity": (0.05, 0.4)},
    "usual": {},
    "opaque": {"opacity": (0.7, 0.9999), "scale": 0.5},
    "tiny": {"scale": 0.004},
}


@pytest.mark.parametrize("size", [(32, 128), (3, 2), (1, 1)], ids=["one chunk", "many chunks", "one entry each"])
@pytest.mark.parametrize("scene", SCENES)
def test_agrees_with_the_loop_over_all_gaussians(book, generator, monkeypatch, scene, size):
    monkeypatch.setattr(chunks, "RANKS", size[0])
    monkeypatch.setattr(chunks, "TILES", size[1])
    projection, rgb = screen(book, generator, 40, **SCENES[scene])
    image = composite(*splats(projection, rgb), tile_intersections(projection, book.camera), book.camera)
    leaves = [x.detach().clone().requires_grad_() for x in splats(projection, rgb)]
    u, v = leaves[0].unbind(-1)
    truth = book.blend(u, v, leaves[1], leaves[4], leaves[2], leaves[3], book.camera, projection.visible)
    for name in ("rgb", "depth_m", "alpha"):
        torch.testing.assert_close(getattr(image, name), getattr(truth, name).detach())
    assert (image.first_index == truth.first_index).all()
    assert (image.dominant_index == truth.dominant_index).all()
    if scene == "opaque":
        assert (projection.opacity > 0.99).any()
        assert (truth.alpha > 0.999).any(), "some pixels should stop in this test"

    v_rgb, v_depth, v_alpha = torch.randn(5, 19, 27, generator=generator, dtype=torch.float64).split([3, 1, 1])
    v_rgb, v_depth, v_alpha = v_rgb.permute(1, 2, 0), v_depth[0], v_alpha[0]
    loss = (truth.rgb * v_rgb).sum() + (truth.depth_m * v_depth).sum() + (truth.alpha * v_alpha).sum()
    expected = torch.autograd.grad(loss, leaves)
    found = composite_vjp(image.saved, v_rgb, v_depth, v_alpha)
    for name, e in zip(NAMES, expected, strict=True):
        torch.testing.assert_close(
            getattr(found, name), e, atol=1e-9, rtol=1e-9, msg=lambda m, name=name: f"{name}: {m}"
        )


def test_vjp_by_finite_differences(book, generator):
    projection, rgb = screen(book, generator, 6)
    camera = Camera(width=9, height=7, fx=1.0, fy=1.0, cx=1.0, cy=1.0)
    near = dataclasses.replace(projection, uv=projection.uv * 0.35)
    lists = tile_intersections(near, camera)
    assert len(lists.gaussian) > 6

    def forward(*x):
        image = composite(*x, lists, camera)
        return image.rgb, image.depth_m, image.alpha

    def vjp(x, *v):
        g = composite_vjp(composite(*x, lists, camera).saved, *v)
        return tuple(getattr(g, name) for name in NAMES)

    book.finite_difference_check(forward, vjp, splats(near, rgb), generator)


@pytest.mark.parametrize("tile_px", [1, 3, 4, 16, 32])
def test_does_not_depend_on_the_tile_size(book, generator, tile_px):
    projection, rgb = screen(book, generator, 50, opacity=(0.3, 0.999))
    v = torch.randn(19, 27, 3, generator=generator, dtype=torch.float64)
    usual = composite(*splats(projection, rgb), tile_intersections(projection, book.camera), book.camera)
    other = composite(
        *splats(projection, rgb), tile_intersections(projection, book.camera, tile_px=tile_px), book.camera
    )
    for name in ("rgb", "depth_m", "alpha", "first_index", "dominant_index"):
        torch.testing.assert_close(getattr(other, name), getattr(usual, name))
    g_usual, g_other = composite_vjp(usual.saved, v), composite_vjp(other.saved, v)
    for name in NAMES:
        torch.testing.assert_close(getattr(g_other, name), getattr(g_usual, name), atol=1e-10, rtol=1e-9)


def test_inputs_are_left_alone(book, generator):
    projection, rgb = screen(book, generator, 20)
    before = [x.clone() for x in splats(projection, rgb)]
    image = composite(*splats(projection, rgb), tile_intersections(projection, book.camera), book.camera)
    v = torch.ones(19, 27, 3, dtype=torch.float64)
    first, second = composite_vjp(image.saved, v), composite_vjp(image.saved, v)
    for name in NAMES:
        assert torch.equal(getattr(first, name), getattr(second, name)), "the gradient can be asked for twice"
    for x, b in zip(splats(projection, rgb), before, strict=True):
        assert torch.equal(x, b)
