"""What a map shows of its surface: one opaque disc by hand, agreement with the renderer and the
disc depth."""

import dataclasses
import math

import pytest
import torch

from gsfusion_nb.config import DiscConfig
from gsfusion_nb.geometry import pixel_grid, quaternion, rays, se3
from gsfusion_nb.render import (
    blended_depth_m,
    disc_depth,
    disc_depth_vjp,
    project_gaussians,
    render,
    render_forward,
    surface_depth_m,
    view_surface,
)
from gsfusion_nb.render.constants import OPAQUE_ALPHA
from gsfusion_nb.types import Camera, GaussianParams

CAMERA = Camera(
    width=33,
    height=9,
    fx=30.0,
    fy=28.0,
    cx=16.2,
    cy=4.4,
)
EYE = torch.eye(4, dtype=torch.float64)


def leaning_disc(
    degrees: float, *, radius=0.5, opacity=0.95, centre=(0.0, 0.0, 2.0)
) -> GaussianParams:
    """One disc whose normal (sin a, 0, cos a) leans from the viewing direction by a about the y
    axis."""
    half = math.radians(degrees) / 2
    return GaussianParams(
        xyz_W=torch.tensor([centre], dtype=torch.float64),
        log_scale=torch.tensor([[radius, 0.9 * radius, 0.001]], dtype=torch.float64).log(),
        quat=3.0 * torch.tensor([[math.cos(half), 0.0, math.sin(half), 0.0]], dtype=torch.float64),
        opacity_logit=torch.tensor([opacity], dtype=torch.float64).logit(),
        sh=torch.zeros(1, 1, 3, dtype=torch.float64),
    )


def everywhere() -> torch.Tensor:
    return torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.int64)


def plane_depth(degrees: float, i) -> torch.Tensor:
    """x sin a + (z - 2) cos a = 0 and x = X z give z = 2 / (1 + X tan a)."""
    X = (torch.as_tensor(i, dtype=torch.float64) + 0.5 - CAMERA.cx) / CAMERA.fx
    return 2 / (1 + X * math.tan(math.radians(degrees)))


def test_leaning_disc_by_hand():
    params = leaning_disc(30)
    out, _ = render_forward(params, CAMERA, EYE, opaque_alpha=OPAQUE_ALPHA)
    disc = disc_depth(params, CAMERA, EYE, out.hit_index)
    at = [13, 16, 19]
    assert (out.hit_index[4, at] == 0).all()
    # 1 + tan 30 (13.5 - 16.2) / 30 = 0.948038, likewise 1.005774 and 1.063509
    expected = torch.tensor([2.109620, 1.988519, 1.880567], dtype=torch.float64)
    torch.testing.assert_close(
        disc.depth_m[4, at],
        expected,
        atol=2e-6,
        rtol=0,
    )
    torch.testing.assert_close(disc.depth_m[4, at], plane_depth(30, at))
    assert disc.on_plane[4, at].all()
    normal = torch.tensor([-0.5, 0, -math.sqrt(0.75)], dtype=torch.float64)
    torch.testing.assert_close(disc.normal_W[4, at], normal.expand(3, 3))


def test_hit_ends_where_alpha_falls_below_the_threshold():
    """A flat disc: alpha = 0.95 exp(-d^2 / 2 (sigma^2 + 0.3)) with sigma = 30 * 0.1 / 2 px along
    the row."""
    params = leaning_disc(0, radius=0.1)
    out, _ = render_forward(params, CAMERA, EYE, opaque_alpha=OPAQUE_ALPHA)
    reach = math.sqrt(2 * math.log(0.95 / OPAQUE_ALPHA) * (1.5**2 + 0.3))
    offset = (torch.arange(33) + 0.5 - 16.2).abs()
    # the row's centre is 0.1 px from the disc's
    assert ((out.hit_index[4] == 0) == (offset < reach)).all()
    disc = disc_depth(params, CAMERA, EYE, out.hit_index)
    missed = out.hit_index < 0
    assert (out.hit_index[missed] == -1).all()
    assert (disc.depth_m[missed] == 0).all()
    assert (disc.normal_W[missed] == 0).all()
    assert not disc.on_plane[missed].any()
    assert missed.any()


def test_steep_disc_gives_its_centre():
    disc = disc_depth(leaning_disc(80), CAMERA, EYE, everywhere())
    X = (torch.arange(33) + 0.5 - CAMERA.cx) / CAMERA.fx
    Y = (4 + 0.5 - CAMERA.cy) / CAMERA.fy
    angle = math.radians(80)
    cosine = (X * math.sin(angle) + math.cos(angle)).abs() / (X * X + Y * Y + 1).sqrt()
    steep = cosine < 0.5
    assert steep[16]
    assert not steep.all()
    assert (disc.depth_m[4, steep] == 2).all()
    assert not disc.on_plane[4, steep].any()
    lenient = disc_depth(leaning_disc(80), CAMERA, EYE, everywhere(), min_cosine=0.1)
    torch.testing.assert_close(lenient.depth_m[4, 16], plane_depth(80, 16))


def test_far_from_the_disc_gives_its_centre():
    i = torch.arange(33)
    z = plane_depth(45, i).expand(9, -1)
    near = (z - 2).abs() <= 0.2
    assert near.any()
    assert not near.all()
    disc = disc_depth(leaning_disc(45, radius=0.2), CAMERA, EYE, everywhere())
    paper = disc_depth(
        leaning_disc(45, radius=0.2),
        CAMERA,
        EYE,
        everywhere(),
        max_offset=None,
    )
    wider = disc_depth(
        leaning_disc(45, radius=0.1),
        CAMERA,
        EYE,
        everywhere(),
        max_offset=2.0,
    )
    allowed = paper.on_plane  # by the angle alone
    torch.testing.assert_close(disc.depth_m, torch.where(near & allowed, z, 2.0))
    torch.testing.assert_close(paper.depth_m, torch.where(allowed, z, 2.0))
    torch.testing.assert_close(wider.depth_m, disc.depth_m)
    assert (allowed & ~near).any()


def test_a_plane_met_behind_the_camera_gives_the_centre():
    """Normal at 80 degrees: 1 + X tan a < 0 for X < -0.176."""
    disc = disc_depth(
        leaning_disc(80),
        CAMERA,
        EYE,
        everywhere(),
        max_offset=None,
        min_cosine=0.05,
    )
    behind = plane_depth(80, torch.arange(33)) < 0
    assert behind.any()
    assert (disc.depth_m[:, behind] == 2).all()
    assert (disc.depth_m > 0).all()


def test_transparent_gaussians_are_never_hit():
    out, _ = render_forward(leaning_disc(0, opacity=0.1), CAMERA, EYE, opaque_alpha=OPAQUE_ALPHA)
    assert (out.alpha > 0.05).any()
    assert (out.hit_index == -1).all()


def hit_scene(scene, generator, n=25):
    """Discs of all inclinations, and hits that meet planes and that fall back to centres."""
    params = scene.random_map(generator, n, opacity=(0.7, 0.99), scale=0.3)
    hit_index = render_forward(params, scene.camera, scene.pose, opaque_alpha=0.5)[0].hit_index
    on_plane = disc_depth(params, scene.camera, scene.pose, hit_index).on_plane
    assert on_plane.any()
    assert (~on_plane & (hit_index >= 0)).any()
    assert (hit_index < 0).any()
    return params, hit_index


def moved(params, xyz_W, quat):
    return GaussianParams(
        xyz_W=xyz_W,
        log_scale=params.log_scale,
        quat=quat,
        opacity_logit=params.opacity_logit,
        sh=params.sh,
    )


@pytest.mark.parametrize("max_offset", [1.0, None])
def test_vjp_by_finite_differences(scene, generator, max_offset):
    params, hit_index = hit_scene(scene, generator)
    view = scene.camera, scene.pose, hit_index

    def forward(*x):
        return (disc_depth(moved(params, *x), *view, max_offset=max_offset).depth_m,)

    def vjp(x, v_depth_m):
        return disc_depth_vjp(moved(params, *x), *view, v_depth_m, max_offset=max_offset)

    scene.finite_difference_check(forward, vjp, (params.xyz_W, params.quat), generator)


def test_vjp_is_the_derivative_that_autograd_finds(scene, generator):
    params, hit_index = hit_scene(scene, generator)
    leaves = {name: getattr(params, name).clone().requires_grad_() for name in scene.columns}
    disc = disc_depth(GaussianParams(**leaves), scene.camera, scene.pose, hit_index)
    v = torch.randn(disc.depth_m.shape, generator=generator, dtype=torch.float64)
    inputs = [leaves[name] for name in ("xyz_W", "quat", "opacity_logit", "log_scale")]
    v_xyz, v_quat, *nothing = torch.autograd.grad(
        (disc.depth_m * v).sum(), inputs, allow_unused=True
    )
    assert all(n is None or not n.any() for n in nothing)
    found = disc_depth_vjp(params, scene.camera, scene.pose, hit_index, v)
    torch.testing.assert_close(found[0], v_xyz)
    torch.testing.assert_close(found[1], v_quat)
    unseen = ~torch.isin(torch.arange(len(params)), hit_index)
    assert unseen.any()
    assert not found[0][unseen].any()
    assert not found[1][unseen].any()


def test_depth_lies_on_the_ray_and_on_the_plane(scene, generator):
    """An independent witness: distance of the point from the plane, with the normal as the least
    eigenvector."""
    params, hit_index = hit_scene(scene, generator)
    disc = disc_depth(params, scene.camera, scene.pose, hit_index)
    R = quaternion.to_matrix(params.quat)
    cov = R @ torch.diag_embed((2 * params.log_scale).exp()) @ R.transpose(1, 2)
    normal = torch.linalg.eigh(cov).eigenvectors[:, :, 0]
    ray = rays(scene.camera, pixel_grid(scene.camera, dtype=torch.float64)) @ scene.pose[:3, :3].T
    on = disc.on_plane
    g = hit_index[disc.on_plane]
    to_centre = (ray * disc.depth_m[..., None])[on] + scene.pose[:3, 3] - params.xyz_W[g]
    assert (to_centre * normal[g]).sum(-1).abs().max() < 1e-10
    torch.testing.assert_close(
        (disc.normal_W[on] * normal[g]).sum(-1).abs(),
        torch.ones(len(g), dtype=torch.float64),
    )
    assert ((disc.normal_W[on] * ray[on]).sum(-1) < 0).all()
    centres = (params.xyz_W - scene.pose[:3, 3]) @ scene.pose[:3, 2]
    fallback = ~on & (hit_index >= 0)
    torch.testing.assert_close(disc.depth_m[fallback], centres[hit_index[fallback]])


def test_vjp_of_some_rows(scene, generator):
    params, hit_index = hit_scene(scene, generator)
    v = torch.randn(hit_index.shape, generator=generator, dtype=torch.float64)
    rows = torch.arange(len(params)) % 3 == 0
    full = disc_depth_vjp(params, scene.camera, scene.pose, hit_index, v)
    some = disc_depth_vjp(params, scene.camera, scene.pose, hit_index, v, rows=rows)
    for f, s in zip(full, some, strict=True):
        torch.testing.assert_close(s, torch.where(rows[:, None], f, 0.0))
        assert s.any()
    with pytest.raises(ValueError, match="rows must be"):
        disc_depth_vjp(params, scene.camera, scene.pose, hit_index, v, rows=rows[1:])


CAMERA_SURFACE = Camera(
    width=21,
    height=15,
    fx=30.0,
    fy=30.0,
    cx=10.5,
    cy=7.5,
)


def discs(*rows: tuple[float, float, float]) -> GaussianParams:
    """Flat discs that face the camera at the identity pose: (depth, radius, opacity) each, on the
    optical axis."""
    z, radius, opacity = (torch.tensor(c, dtype=torch.float32) for c in zip(*rows, strict=True))
    n = len(rows)
    return GaussianParams(
        xyz_W=torch.stack([torch.zeros(n), torch.zeros(n), z], dim=1),
        log_scale=(radius[:, None] * torch.tensor([1.0, 1.0, 0.1])).log(),
        quat=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        opacity_logit=opacity.logit(),
        sh=torch.zeros(n, 1, 3),
    )


def test_a_transparent_disc_colours_but_is_not_hit():
    view = view_surface(
        discs((1.0, 0.5, 0.1), (2.0, 0.5, 0.99)),
        CAMERA_SURFACE,
        torch.eye(4),
    )
    assert view.hit_index[7, 10] == 1
    assert view.dominant_index[7, 10] == 1
    assert float(view.depth_m[7, 10]) == pytest.approx(2.0)
    alone = view_surface(discs((1.0, 0.5, 0.1)), CAMERA_SURFACE, torch.eye(4))
    assert (alone.hit_index == -1).all()
    assert not alone.depth_m.any()
    assert float(alone.transmittance[7, 10]) == pytest.approx(0.9, abs=1e-4)


def test_blended_depth_by_hand():
    """Two layers of opacity 0.5 and 0.8: weights 0.5 and 0.4, depth (0.5 * 1 + 0.4 * 2) / 0.9 in
    the middle."""
    params = discs((1.0, 5.0, 0.5), (2.0, 10.0, 0.8))
    view = view_surface(params, CAMERA_SURFACE, torch.eye(4), DiscConfig(depth="blended"))
    assert float(view.depth_m[7, 10]) == pytest.approx(1.3 / 0.9, rel=1e-3)
    thin = render(discs((1.0, 5.0, 0.4)), CAMERA_SURFACE, torch.eye(4))
    assert not blended_depth_m(thin).any()
    assert float(blended_depth_m(thin, 0.3)[7, 10]) == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize(
    "config",
    [
        DiscConfig(),
        DiscConfig(opaque_alpha=0.4, max_offset=None, min_cosine=0.2),
        DiscConfig(depth="blended"),
    ],
)
def test_agrees_with_its_parts(scene, generator, config):
    params = scene.random_map(
        generator,
        30,
        opacity=(0.5, 0.99),
        scale=0.3,
        dtype=torch.float32,
    )
    T_WC = scene.pose.float()
    view = view_surface(params, scene.camera, T_WC, config)
    output, _ = render_forward(params, scene.camera, T_WC, opaque_alpha=config.opaque_alpha)
    disc = disc_depth(
        params,
        scene.camera,
        T_WC,
        output.hit_index,
        max_offset=config.max_offset,
        min_cosine=config.min_cosine,
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
    params = scene.random_map(
        generator,
        40,
        opacity=(0.9, 0.99),
        scale=0.3,
        dtype=torch.float32,
    )
    view = view_surface(params, scene.camera, scene.pose.float())
    seen = view.hit_index >= 0
    centre = params.xyz_W[view.hit_index[seen]]
    to_camera = scene.pose[:3, 3].float() - centre
    assert ((view.normal_W[seen] * to_camera).sum(1) > 0).all()
    torch.testing.assert_close(
        view.normal_W[seen].norm(dim=1),
        torch.ones(int(seen.sum())),
    )


def test_an_empty_map():
    view = view_surface(
        discs((2.0, 0.5, 0.99))[:0],
        CAMERA_SURFACE,
        se3.exp(torch.zeros(6)),
    )
    assert view.transmittance.eq(1).all()
    assert view.hit_index.eq(-1).all()
    for field in dataclasses.fields(view):
        assert torch.isfinite(getattr(view, field.name)).all()


def test_a_gradient_of_another_size_is_refused():
    with pytest.raises(ValueError, match=r"v_depth_m must be \[9, 33\], got \[9, 32\]"):
        disc_depth_vjp(
            leaning_disc(30),
            CAMERA,
            EYE,
            everywhere(),
            torch.zeros(9, 32, dtype=torch.float64),
        )


def test_a_hit_of_another_map_is_refused():
    with pytest.raises(
        ValueError, match="hit_index must name rows of the 1 Gaussians, got 1; take the hit_index"
    ):
        disc_depth(leaning_disc(30), CAMERA, EYE, everywhere() + 1)


def test_only_on_request(scene, generator):
    params = scene.random_map(generator, 10)
    plain, asked = (
        render_forward(params, scene.camera, scene.pose, opaque_alpha=o)[0] for o in (None, 0.5)
    )
    assert plain.hit_index is None
    assert asked.hit_index.dtype == torch.int64
    for name in ("rgb", "depth_m", "alpha", "first_index", "dominant_index"):
        assert torch.equal(getattr(plain, name), getattr(asked, name))
    with pytest.raises(ValueError, match="opaque_alpha must be > 0"):
        render_forward(params, scene.camera, scene.pose, opaque_alpha=0.0)


@pytest.mark.parametrize(
    "opacity",
    [(0.05, 0.7), (0.6, 0.9999)],
    ids=["thin", "opaque"],
)
def test_hits_agree_with_a_loop_over_pixels(scene, generator, opacity):
    params = scene.random_map(generator, 40, opacity=opacity, scale=0.25)
    found = render_forward(params, scene.camera, scene.pose, opaque_alpha=0.55)[0].hit_index
    p = project_gaussians(params, scene.camera, scene.pose)
    A, B, C = p.conic.unbind(1)
    Q = torch.stack([A, B, B, C], dim=1).view(-1, 2, 2)
    order = p.depth_m.argsort()
    # the centre of pixel (y, x) from each Gaussian, nearest first
    grid = pixel_grid(scene.camera, dtype=torch.float64)
    d = grid[..., None, :] - p.uv[order]
    alphas = (
        p.opacity[order] * torch.exp(-0.5 * torch.einsum("yxni,nij,yxnj->yxn", d, Q[order], d))
    ).clamp(max=0.99)
    expected = torch.full_like(found, -1)
    for y, row in enumerate(alphas.tolist()):
        for x, pixel in enumerate(row):
            for n, alpha in zip(order.tolist(), pixel, strict=True):
                if alpha >= 0.55:
                    expected[y, x] = n
                    break
    assert torch.equal(found, expected)
    assert len(expected.unique()) > 3


def test_no_gaussians_at_all(scene, generator):
    params = scene.random_map(generator, 3)[:0]
    hit_index = render_forward(params, scene.camera, scene.pose, opaque_alpha=0.6)[0].hit_index
    assert (hit_index == -1).all()
    assert not disc_depth(params, scene.camera, scene.pose, hit_index).depth_m.any()
    v_xyz, v_quat = disc_depth_vjp(
        params,
        scene.camera,
        scene.pose,
        hit_index,
        torch.ones(19, 27, dtype=torch.float64),
    )
    assert v_xyz.shape == (0, 3)
    assert v_quat.shape == (0, 4)


def test_wrong_arguments_are_named():
    params = leaning_disc(0)
    hit = everywhere()
    with pytest.raises(ValueError, match="rows of the 1 Gaussians, got 1"):
        disc_depth(params, CAMERA, EYE, hit + 1)
    with pytest.raises(ValueError, match="hit_index must be"):
        disc_depth(params, CAMERA, EYE, hit[1:])
    with pytest.raises(ValueError, match="min_cosine must be > 0"):
        disc_depth(params, CAMERA, EYE, hit, min_cosine=0.0)


def test_a_flat_disc_by_hand():
    view = view_surface(discs((2.0, 0.5, 0.99)), CAMERA_SURFACE, torch.eye(4))
    seen = view.hit_index == 0
    # alpha = 0.99 exp(-d^2 / 2 (7.5^2 + 0.3)) px; a disc is hit down to exp(-0.5)
    i = torch.arange(21) + 0.5 - 10.5
    j = torch.arange(15) + 0.5 - 7.5
    d2 = i[None, :] ** 2 + j[:, None] ** 2
    alpha = 0.99 * torch.exp(-d2 / (2 * (7.5**2 + 0.3)))
    assert torch.equal(seen, alpha >= math.exp(-0.5))
    torch.testing.assert_close(view.depth_m, torch.where(seen, 2.0, 0.0))
    torch.testing.assert_close(
        view.normal_W[seen],
        torch.tensor([0.0, 0, -1]).expand(int(seen.sum()), 3),
    )
    assert not view.normal_W[~seen].any()
    drawn = alpha >= 1 / 255
    torch.testing.assert_close(
        view.transmittance[drawn],
        1 - alpha[drawn].clamp(max=0.99),
        atol=1e-5,
        rtol=0,
    )
    assert (view.dominant_index == 0).all()


def test_some_pixels_only(scene, generator):
    params = scene.random_map(
        generator,
        30,
        opacity=(0.7, 0.99),
        scale=0.3,
        dtype=torch.float32,
    )
    pixels = torch.rand(scene.camera.height, scene.camera.width, generator=generator) < 0.3
    T_WC = scene.pose.float()
    whole, part = (view_surface(params, scene.camera, T_WC, pixels=p) for p in (None, pixels))
    assert torch.equal(part.depth_m, torch.where(pixels, whole.depth_m, 0.0))
    assert torch.equal(part.hit_index, torch.where(pixels, whole.hit_index, -1))
    torch.testing.assert_close(part.rgb, torch.where(pixels[..., None], whole.rgb, 0.0))
