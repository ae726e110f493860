"""Drawing only some pixels, and gradients of only some rows."""

import dataclasses

import pytest
import torch

from gsfusion_nb.render import project_gaussians, render_forward, render_vjp, tile_intersections
from gsfusion_nb.types import Camera, GaussianParams

IMAGES = ("rgb", "depth_m", "alpha", "first_index", "dominant_index", "hit_index")


def columns(params):
    return [getattr(params, f.name) for f in dataclasses.fields(GaussianParams)]


def rows_of(scene, values):
    return GaussianParams(**dict(zip(scene.columns, values, strict=True)))


def cotangents(generator, camera):
    v = torch.randn(
        5,
        camera.height,
        camera.width,
        generator=generator,
        dtype=torch.float64,
    )
    return v[:3].permute(1, 2, 0), v[3], v[4]


def view(width, height) -> Camera:
    return Camera(
        width=width,
        height=height,
        fx=30.0,
        fy=28.0,
        cx=0.48 * width,
        cy=0.53 * height,
    )


def masks(height, width, generator):
    """None, all, one, a rectangle that cuts tiles, and a third of the pixels at random."""
    rectangle = torch.zeros(height, width, dtype=torch.bool)
    rectangle[height // 3 : height // 3 + 6, width // 4 : width // 2 + 1] = True
    one = torch.zeros_like(rectangle)
    one[height // 2, width // 2] = True
    scattered = torch.rand(height, width, generator=generator) < 0.33
    return {
        "none": one & False,
        "all": one | True,
        "one": one,
        "rectangle": rectangle,
        "scattered": scattered,
    }


@pytest.mark.parametrize(
    "size",
    [(27, 19), (8, 16), (1, 1), (65, 9)],
)
def test_same_picture_on_the_mask_and_background_elsewhere(scene, generator, size):
    camera = view(*size)
    params = scene.random_map(
        generator,
        60,
        degree=1,
        opacity=(0.3, 0.999),
        scale=0.25,
    )
    whole, _ = render_forward(params, camera, scene.pose, opaque_alpha=0.5)
    for name, pixels in masks(camera.height, camera.width, generator).items():
        out, _ = render_forward(params, camera, scene.pose, opaque_alpha=0.5, pixels=pixels)
        for image in IMAGES:
            found = getattr(out, image)
            expected = getattr(whole, image)
            torch.testing.assert_close(
                found[pixels], expected[pixels], msg=lambda m, n=name, i=image: f"{n} {i}: {m}"
            )
            assert (found[~pixels] == (-1 if "index" in image else 0)).all(), (name, image)


def test_gradient_is_that_of_the_loss_on_the_mask(scene, generator):
    params = scene.random_map(generator, 50, degree=2, opacity=(0.3, 0.999))
    _, saved = render_forward(params, scene.camera, scene.pose)
    v = cotangents(generator, scene.camera)
    for pixels in masks(scene.camera.height, scene.camera.width, generator).values():
        v_mask = v[0] * pixels[..., None], v[1] * pixels, v[2] * pixels
        v_nonsense = [
            torch.where(
                pixels[..., None] if x.ndim == 3 else pixels,
                x,
                torch.nan,
            )
            for x in v
        ]
        _, saved_mask = render_forward(params, scene.camera, scene.pose, pixels=pixels)
        expected = columns(render_vjp(saved, *v_mask))
        for given in (v, v_mask, v_nonsense):
            for g, e in zip(
                columns(render_vjp(saved_mask, *given)),
                expected,
                strict=True,
            ):
                torch.testing.assert_close(g, e, atol=1e-10, rtol=1e-9)


def test_finite_differences_with_a_mask(scene, generator):
    params = scene.random_map(generator, 4, degree=1, scale=0.3)
    camera = Camera(
        width=9,
        height=7,
        fx=10.0,
        fy=10.0,
        cx=4.4,
        cy=3.6,
    )
    pixels = torch.rand(7, 9, generator=generator) < 0.5

    def forward(*x):
        out, _ = render_forward(rows_of(scene, x), camera, scene.pose, pixels=pixels)
        return out.rgb, out.depth_m, out.alpha

    def vjp(x, *v):
        return tuple(
            columns(
                render_vjp(
                    render_forward(rows_of(scene, x), camera, scene.pose, pixels=pixels)[1],
                    *v,
                )
            )
        )

    alpha = forward(*columns(params))[2]
    assert (alpha[pixels] > 0.3).any()
    scene.finite_difference_check(forward, vjp, columns(params), generator)


def test_gradient_of_some_rows(scene, generator):
    params = scene.random_map(generator, 40, degree=2)
    pixels = masks(scene.camera.height, scene.camera.width, generator)["scattered"]
    _, saved = render_forward(params, scene.camera, scene.pose, pixels=pixels)
    v = cotangents(generator, scene.camera)
    full = columns(render_vjp(saved, *v))
    for rows in (
        torch.arange(40) < 13,
        torch.arange(40) % 3 == 1,
        torch.zeros(40).bool(),
        torch.ones(40).bool(),
    ):
        for g, f in zip(
            columns(render_vjp(saved, *v, rows=rows)),
            full,
            strict=True,
        ):
            assert g.shape == f.shape
            torch.testing.assert_close(g[rows], f[rows])
            assert not g[~rows].any()


def test_finite_differences_of_some_rows(scene, generator):
    """What a frozen row does to the picture stays in the gradients of the others."""
    params = scene.random_map(generator, 5, scale=0.3)
    camera = Camera(
        width=9,
        height=7,
        fx=10.0,
        fy=10.0,
        cx=4.4,
        cy=3.6,
    )
    rows = torch.tensor([True, False, True, False, False])

    def together(moving):
        return [
            c.clone().index_put((rows,), m) for c, m in zip(columns(params), moving, strict=True)
        ]

    def forward(*moving):
        out, _ = render_forward(rows_of(scene, together(moving)), camera, scene.pose)
        return out.rgb, out.depth_m, out.alpha

    def vjp(moving, *v):
        _, saved = render_forward(rows_of(scene, together(moving)), camera, scene.pose)
        return tuple(g[rows] for g in columns(render_vjp(saved, *v, rows=rows)))

    scene.finite_difference_check(forward, vjp, [c[rows] for c in columns(params)], generator)


def test_tiles_without_a_wanted_pixel_are_empty(scene, generator):
    params = scene.random_map(generator, 60, scale=0.25)
    projection = project_gaussians(params, scene.camera, scene.pose)
    pixels = masks(scene.camera.height, scene.camera.width, generator)["rectangle"]
    whole = tile_intersections(projection, scene.camera, tile_px=4)
    lists = tile_intersections(projection, scene.camera, tile_px=4, pixels=pixels)
    active = 0
    for tile in range(lists.tiles_x * lists.tiles_y):
        y = 4 * (tile // lists.tiles_x)
        x = 4 * (tile % lists.tiles_x)
        a, b = (t.gaussian[t.offset[tile] : t.offset[tile + 1]] for t in (whole, lists))
        wanted = bool(pixels[y : y + 4, x : x + 4].any())
        active += wanted
        assert torch.equal(b, a if wanted else a[:0])
    assert 0 < active < lists.tiles_x * lists.tiles_y


def test_no_gaussians(scene, generator):
    params = scene.random_map(generator, 3)[:0]
    pixels = masks(scene.camera.height, scene.camera.width, generator)["scattered"]
    out, saved = render_forward(params, scene.camera, scene.pose, opaque_alpha=0.5, pixels=pixels)
    assert not out.alpha.any()
    assert (out.hit_index == -1).all()
    gradient = render_vjp(
        saved,
        *cotangents(generator, scene.camera),
        rows=torch.zeros(0, dtype=torch.bool),
    )
    assert [g.shape for g in columns(gradient)] == [c.shape for c in columns(params)]


def test_wrong_sizes_are_named(scene, generator):
    params = scene.random_map(generator, 3)
    everywhere = torch.ones(scene.camera.height, scene.camera.width, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"pixels must be \[19, 27\], got \[19, 26\]"):
        render_forward(params, scene.camera, scene.pose, pixels=everywhere[:, 1:])
    _, saved = render_forward(params, scene.camera, scene.pose, pixels=everywhere)
    with pytest.raises(ValueError, match=r"rows must be \[3\], got \[2\]"):
        render_vjp(
            saved,
            torch.zeros(19, 27, 3),
            rows=torch.ones(2, dtype=torch.bool),
        )
