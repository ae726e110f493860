"""What is lent to gsplat, against sums written out by hand and against the plain definition of blending."""

import pytest
import torch

from gsfusion_nb.compare.bench import gsplat_torch, random_scene
from gsfusion_nb.compare.bench.other_programs import why_not
from gsfusion_nb.compare.bench.raster import by_autograd, compare_to_baseline
from gsfusion_nb.render import render_forward, render_vjp


def test_weights_of_two_rays_by_hand():
    alphas = torch.tensor([0.5, 0.25, 0.2, 0.8])
    w, T = gsplat_torch._weights(alphas, ray_indices=torch.tensor([7, 7, 7, 2]), n_rays=9)
    assert T.tolist() == pytest.approx([1, 0.5, 0.375, 1])
    assert w.tolist() == pytest.approx([0.5, 0.125, 0.075, 0.8])


def test_sums_over_rays_by_hand():
    values = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    rays = torch.tensor([2, 2, 0])
    total = gsplat_torch._sums(torch.tensor([0.5, 1.0, 2.0]), values, ray_indices=rays, n_rays=3)
    assert total.tolist() == [[10, 12], [0, 0], [3.5, 5]]
    assert gsplat_torch._sums(torch.ones(3), None, ray_indices=rays, n_rays=3).tolist() == [[1], [0], [2]]


def test_weights_pass_the_gradient_check():
    alphas = torch.tensor([0.5, 0.25, 0.2, 0.8], dtype=torch.float64, requires_grad=True)
    rays = torch.tensor([1, 1, 1, 0])
    assert torch.autograd.gradcheck(lambda a: gsplat_torch._weights(a, ray_indices=rays, n_rays=2)[0], alphas)


def test_pairs_are_those_of_a_loop_over_pixels(generator):
    """Tiles of 4 px on a picture of 6 x 5: partial tiles, one empty tile, early stop."""
    n, width, height, tile_px = 12, 6, 5, 4
    uv = torch.rand(1, n, 2, generator=generator) * torch.tensor([4.0, 5.0])
    conic = torch.tensor([[0.5, 0.1, 0.4]]).expand(n, 3)[None]
    opacity = torch.rand(1, n, generator=generator) * 0.5 + 0.5
    ids = torch.cat([torch.arange(n), torch.arange(n), torch.arange(n)]).int()
    offsets = torch.tensor([[[0, n], [n, 2 * n]]])  # the second tile holds nothing
    g, p, image = gsplat_torch._pairs(
        0, 100, torch.ones(1, height, width), uv, conic, opacity, width, height, tile_px, offsets, ids
    )
    expected = []
    bounds = [0, n, n, 2 * n, 3 * n]
    for tile in range(4):
        rows = ids[bounds[tile] : bounds[tile + 1]].tolist()
        for y in range(tile // 2 * 4, min(tile // 2 * 4 + 4, height)):
            for x in range(tile % 2 * 4, min(tile % 2 * 4 + 4, width)):
                T = 1.0
                for k in rows:
                    dx, dy = x + 0.5 - float(uv[0, k, 0]), y + 0.5 - float(uv[0, k, 1])
                    sigma = 0.25 * dx * dx + 0.2 * dy * dy + 0.1 * dx * dy
                    alpha = min(0.999, float(opacity[0, k]) * 2.718281828459045**-sigma)
                    if alpha < 1 / 255:
                        continue
                    T *= 1 - alpha
                    if T <= 1e-4:
                        break
                    expected.append((k, y * width + x))
    assert list(zip(g.tolist(), p.tolist(), strict=True)) == expected
    assert int(image.abs().sum()) == 0


@pytest.mark.skipif(why_not("gsplat") is not None, reason="gsplat is not installed")
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_the_peer_draws_our_picture_with_our_gradients(sh_degree):
    scene = random_scene(300, 64, 48, sh_degree=sh_degree)
    output, saved = render_forward.reference(scene.params, scene.camera, scene.T_WC)
    truth = (output.rgb, render_vjp.reference(saved, scene.v_rgb))
    _, values = compare_to_baseline(by_autograd(gsplat_torch.render, scene, backward=True), truth)
    assert values["psnr_to_torch_db"] > 90
    assert values["least_gradient_cosine"] > 0.9999
