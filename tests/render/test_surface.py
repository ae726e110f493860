"""What a map shows of its surface: one opaque disc by hand, agreement with the renderer and the disc depth."""

import dataclasses
import math

import pytest
import torch

from gsfusion_nb.config import DiscConfig
from gsfusion_nb.geometry import se3
from gsfusion_nb.render import blended_depth_m, disc_depth, render, render_forward, surface_depth_m, view_surface
from gsfusion_nb.types import Camera, GaussianParams

CAMERA = Camera(width=21, height=15, fx=30.0, fy=30.0, cx=10.5, cy=7.5)


def discs(*rows: tuple[float, float, float]) -> GaussianParams:
    """Flat discs that face the camera at the identity pose: (depth, radius, opacity) each, on the optical axis."""
    z, radius, opacity = (torch.tensor(c, dtype=torch.float32) for c in zip(*rows, strict=True))
    n = len(rows)
    return GaussianParams(
        xyz_W=torch.stack([torch.zeros(n), torch.zeros(n), z], dim=1),
        log_scale=(radius[:, None] * torch.tensor([1.0, 1.0, 0.1])).log(),
        quat=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        opacity_logit=opacity.logit(),
        sh=torch.zeros(n, 1, 3),
    )


def test_a_flat_disc_by_hand():
    view = view_surface(discs((2.0, 0.5, 0.99)), CAMERA, torch.eye(4))
    seen = view.hit_index == 0
    # alpha = 0.99 exp(-d^2 / 2 (7.5^2 + 0.3)) px; a disc is hit down to exp(-0.5)
    i, j = torch.arange(21) + 0.5 - 10.5, torch.arange(15) + 0.5 - 7.5
    d2 = i[None, :] ** 2 + j[:, None] ** 2
    alpha = 0.99 * torch.exp(-d2 / (2 * (7.5**2 + 0.3)))
    assert torch.equal(seen, alpha >= math.exp(-0.5))
    torch.testing.assert_close(view.depth_m, torch.where(seen, 2.0, 0.0))
    torch.testing.assert_close(view.normal_W[seen], torch.tensor([0.0, 0, -1]).expand(int(seen.sum()), 3))
    assert not view.normal_W[~seen].any()
    drawn = alpha >= 1 / 255
    torch.testing.assert_close(view.transmittance[drawn], 1 - alpha[drawn].clamp(max=0.99), atol=1e-5, rtol=0)
    assert (view.dominant_index == 0).all()


def test_a_transparent_disc_colours_but_is_not_hit():
    view = view_surface(discs((1.0, 0.5, 0.1), (2.0, 0.5, 0.99)), CAMERA, torch.eye(4))
    assert view.hit_index[7, 10] == 1
    assert view.dominant_index[7, 10] == 1
    assert float(view.depth_m[7, 10]) == pytest.approx(2.0)
    alone = view_surface(discs((1.0, 0.5, 0.1)), CAMERA, torch.eye(4))
    assert (alone.hit_index == -1).all()
    assert not alone.depth_m.any()
    assert float(alone.transmittance[7, 10]) == pytest.approx(0.9, abs=1e-4)


def test_blended_depth_by_hand():
    """Two layers of opacity 0.5 and 0.8: weights 0.5 and 0.4, depth (0.5 * 1 + 0.4 * 2) / 0.9 in the middle."""
    params = discs((1.0, 5.0, 0.5), (2.0, 10.0, 0.8))
    view = view_surface(params, CAMERA, torch.eye(4), DiscConfig(depth="blended"))
    assert float(view.depth_m[7, 10]) == pytest.approx(1.3 / 0.9, rel=1e-3)
    thin = render(discs((1.0, 5.0, 0.4)), CAMERA, torch.eye(4))
    assert not blended_depth_m(thin).any()
    assert float(blended_depth_m(thin, 0.3)[7, 10]) == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize(
    "config",
    [DiscConfig(), DiscConfig(opaque_alpha=0.4, max_offset=None, min_cosine=0.2), DiscConfig(depth="blended")],
)
def test_agrees_with_its_parts(scene, generator, config):
    params = scene.random_map(generator, 30, opacity=(0.5, 0.99), scale=0.3, dtype=torch.float32)
    T_WC = scene.pose.float()
    view = view_surface(params, scene.camera, T_WC, config)
    output, _ = render_forward(params, scene.camera, T_WC, opaque_alpha=config.opaque_alpha)
    disc = disc_depth(
        params, scene.camera, T_WC, output.hit_index, max_offset=config.max_offset, min_cosine=config.min_cosine
    )
    assert torch.equal(view.rgb, output.rgb)
    assert torch.equal(view.hit_index, output.hit_index)
    assert torch.equal(view.dominant_index, output.dominant_index)
    assert torch.equal(view.normal_W, disc.normal_W)
    torch.testing.assert_close(view.transmittance, 1 - output.alpha)
    expected = disc.depth_m if config.depth == "disc" else blended_depth_m(output)
    assert torch.equal(view.depth_m, expected)
    assert torch.equal(surface_depth_m(params, scene.camera, T_WC, output, config), expected)
    assert (view.depth_m > 0).any()


def test_normals_face_the_camera_wherever_it_is(scene, generator):
    params = scene.random_map(generator, 40, opacity=(0.9, 0.99), scale=0.3, dtype=torch.float32)
    view = view_surface(params, scene.camera, scene.pose.float())
    seen = view.hit_index >= 0
    centre = params.xyz_W[view.hit_index[seen]]
    to_camera = scene.pose[:3, 3].float() - centre
    assert ((view.normal_W[seen] * to_camera).sum(1) > 0).all()
    torch.testing.assert_close(view.normal_W[seen].norm(dim=1), torch.ones(int(seen.sum())))


def test_some_pixels_only(scene, generator):
    params = scene.random_map(generator, 30, opacity=(0.7, 0.99), scale=0.3, dtype=torch.float32)
    pixels = torch.rand(scene.camera.height, scene.camera.width, generator=generator) < 0.3
    T_WC = scene.pose.float()
    whole, part = (view_surface(params, scene.camera, T_WC, pixels=p) for p in (None, pixels))
    assert torch.equal(part.depth_m, torch.where(pixels, whole.depth_m, 0.0))
    assert torch.equal(part.hit_index, torch.where(pixels, whole.hit_index, -1))
    torch.testing.assert_close(part.rgb, torch.where(pixels[..., None], whole.rgb, 0.0))


def test_an_empty_map():
    view = view_surface(discs((2.0, 0.5, 0.99))[:0], CAMERA, se3.exp(torch.zeros(6)))
    assert view.transmittance.eq(1).all()
    assert view.hit_index.eq(-1).all()
    for field in dataclasses.fields(view):
        assert torch.isfinite(getattr(view, field.name)).all()
