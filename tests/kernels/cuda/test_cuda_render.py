"""Picture, indices and gradients."""

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.render import render_forward, render_vjp
from gsfusion_nb.types import Camera, GaussianParams

NAMES = ("xyz_W", "log_scale", "quat", "opacity_logit", "sh")
INDICES = ("first_index", "dominant_index", "hit_index")
FLIPS = 2e-2 if torch.cuda.is_available() else 2e-3
"""Share of gradients that may be off because a pair falls on the other side of a cut; so far none on the CPU."""
SIZES = [(0, 32, 16), (1, 16, 16), (60, 48, 40), (37, 33, 17)]


def some_pixels(height: int, width: int) -> torch.Tensor:
    """Rectangles that cut tiles, and leave many out."""
    pixels = torch.zeros(height, width, dtype=torch.bool)
    pixels[height // 3 : height // 2, : width // 3] = True
    pixels[: height // 4, width // 2 : width // 2 + 5] = True
    return pixels


def check_pictures(compare, ours, theirs, share=2e-3):
    """A pair within rounding of the 1/255 cut or the 1e-4 stop may fall on either side."""
    for name in ("rgb", "depth_m", "alpha"):
        compare("render_forward", name, getattr(ours, name), getattr(theirs, name), 1e-5, share=share)
    for name in INDICES:
        assert getattr(ours, name).dtype == torch.int64
        assert (getattr(ours, name).cpu() != getattr(theirs, name)).double().mean() <= share


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize(("n", "width", "height"), SIZES)
def test_picture_and_gradients(n, width, height, degree, make_scene, make_camera, make_images, pose, to, compare):
    camera, params = make_camera(width, height), make_scene(n, degree)
    v = make_images(camera)
    theirs, saved = render_forward.reference(params, camera, pose, opaque_alpha=0.6)
    expected = render_vjp.reference(saved, *v)
    with use_backend("cuda"):
        ours, saved = render_forward(to(params), camera, to(pose), opaque_alpha=0.6)
        found = render_vjp(saved, *to(v))
    check_pictures(compare, ours, theirs)
    for name in NAMES:
        compare("render_vjp", name, getattr(found, name), getattr(expected, name), 2e-5, share=FLIPS)


def test_many_gaussians_in_a_tile(make_scene, make_camera, make_images, pose, to, compare):
    """Lists longer than the 128 entries that a block keeps, Gaussians of many tiles, and pixels that go dark early."""
    camera, params = make_camera(48, 33), make_scene(800, 0, scale_m=0.12)
    v = make_images(camera)
    theirs, saved = render_forward.reference(params, camera, pose, opaque_alpha=0.6)
    expected = render_vjp.reference(saved, *v)
    with use_backend("cuda"):
        ours, saved = render_forward(to(params), camera, to(pose), opaque_alpha=0.6)
        found = render_vjp(saved, *to(v))
    assert int(saved.lists.offset.diff().max()) > 128
    check_pictures(compare, ours, theirs)
    for name in NAMES:
        compare("render_vjp", name, getattr(found, name), getattr(expected, name), 2e-5, share=FLIPS)


def test_some_pixels_and_some_rows(make_scene, make_camera, make_images, pose, to, compare, generator):
    camera, params = make_camera(48, 40), make_scene(60, 1)
    v, pixels = make_images(camera), some_pixels(40, 48)
    rows = torch.rand(60, generator=generator) < 0.4
    theirs, saved = render_forward.reference(params, camera, pose, opaque_alpha=0.6, pixels=pixels)
    expected = render_vjp.reference(saved, *v, rows=rows)
    nonsense = [torch.where(pixels[..., None] if x.ndim == 3 else pixels, x, torch.nan) for x in v]
    with use_backend("cuda"):
        ours, saved = render_forward(to(params), camera, to(pose), opaque_alpha=0.6, pixels=to(pixels))
        found = render_vjp(saved, *to(nonsense), rows=to(rows))
        none, nothing = render_forward(to(params), camera, to(pose), pixels=to(pixels & False))
    assert int(nothing.lists.offset[-1]) == 0
    assert not none.alpha.any()
    check_pictures(compare, ours, theirs)
    assert (ours.dominant_index.cpu()[~pixels] == -1).all()
    for name in NAMES:
        compare("render_vjp", name, getattr(found, name), getattr(expected, name), 2e-5, share=FLIPS)
        assert not getattr(found, name).cpu()[~rows].any()


def test_clamped_pairs_have_no_gradient(make_scene, make_camera, make_images, pose, to, compare):
    """Half of the Gaussians are so opaque that alpha is clamped at 0.99 around their centres."""
    camera, p = make_camera(40, 24), make_scene(40, 0, scale_m=0.4)
    params = GaussianParams(**{**vars(p), "opacity_logit": torch.where(p.opacity_logit > 0, 9.0, -1.0)})
    v = make_images(camera)
    theirs, saved = render_forward.reference(params, camera, pose)
    expected = render_vjp.reference(saved, *v)
    with use_backend("cuda"):
        ours, saved = render_forward(to(params), camera, to(pose))
        found = render_vjp(saved, *to(v))
    assert (theirs.alpha > 0.98).sum() > 50
    compare("clamped", "alpha", ours.alpha, theirs.alpha, 1e-5, share=2e-3)
    for name in NAMES:
        compare("clamped", name, getattr(found, name), getattr(expected, name), 2e-5, share=FLIPS)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_gradient_of_the_viewing_direction(degree, make_scene, make_camera, make_images, pose, to, compare):
    """Gaussians so large that the picture is flat, in strong colours: a centre matters for the direction only."""
    camera, p = make_camera(20, 16), make_scene(24, degree)
    flat = {"log_scale": torch.full((24, 3), 4.0), "opacity_logit": torch.full((24,), -3.0), "sh": 8.0 * p.sh}
    params = GaussianParams(**{**vars(p), **flat})
    v = [x.abs() for x in make_images(camera)]
    _, saved = render_forward.reference(params, camera, pose)
    expected = render_vjp.reference(saved, v[0])
    with use_backend("cuda"):
        found = render_vjp(render_forward(to(params), camera, to(pose))[1], to(v[0]))
    for name in ("xyz_W", "sh"):
        compare("direction", name, getattr(found, name), getattr(expected, name), 2e-5)


def test_frozen_rows_still_stand_in_the_light(to):
    """An opaque wall in front, frozen, leaves 1 % of the light, and so of the gradient, to what is behind it."""
    camera = Camera(width=16, height=16, fx=16.0, fy=16.0, cx=8.0, cy=8.0)
    wall = GaussianParams(
        xyz_W=torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 1.0]]),
        log_scale=torch.full((2, 3), 3.0),
        quat=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1),
        opacity_logit=torch.tensor([0.0, 20.0]),
        sh=torch.ones(2, 1, 3),
    )
    seen = {}
    with use_backend("cuda"):
        for name, params in (("behind", wall), ("alone", wall[:1])):
            _, saved = render_forward(to(params), camera, torch.eye(4))
            rows = torch.tensor([True, False])[: len(params)]
            seen[name] = render_vjp(saved, to(torch.ones(16, 16, 3)), rows=to(rows))
    torch.testing.assert_close(seen["behind"].sh[0], 0.01 * seen["alone"].sh[0], rtol=1e-4, atol=0)
    assert not seen["behind"].sh[1].any()


def test_optional_outputs_and_gradients(make_scene, make_camera, make_images, pose, to, compare):
    camera, params = make_camera(33, 17), make_scene(37, 0)
    v_rgb, v_depth, v_alpha = make_images(camera)
    theirs, saved = render_forward.reference(params, camera, pose, opaque_alpha=0.6)
    with use_backend("cuda"):
        out, ours = render_forward(to(params), camera, pose, with_indices=False)
        hits, _ = render_forward(to(params), camera, pose, with_indices=False, opaque_alpha=0.6)
    assert out.first_index is out.dominant_index is out.hit_index is None
    assert torch.equal(hits.hit_index.cpu(), theirs.hit_index)
    for extra in ({}, {"v_depth_m": v_depth}, {"v_alpha": v_alpha}):
        expected = render_vjp.reference(saved, v_rgb, **extra)
        with use_backend("cuda"):
            found = render_vjp(ours, to(v_rgb), **{k: to(x) for k, x in extra.items()})
        for name in NAMES:
            compare("render_vjp", name, getattr(found, name), getattr(expected, name), 2e-5, share=FLIPS)


def test_gradients_are_the_differences_of_the_reference_in_float64(make_scene, make_camera, make_images, pose, to):
    """d sum(v . images) along a random direction of each parameter, by central differences."""
    camera, params = make_camera(32, 24), make_scene(20, 1, scale_m=0.15)
    v = make_images(camera)
    with use_backend("cuda"):
        _, saved = render_forward(to(params), camera, to(pose))
        found = render_vjp(saved, *to(v))
    double = {name: getattr(params, name).double() for name in NAMES}

    def loss(name, moved):
        out, _ = render_forward.reference(GaussianParams(**{**double, name: moved}), camera, pose.double())
        return float(sum((a * b).sum() for a, b in zip((out.rgb, out.depth_m, out.alpha), v, strict=True)))

    for name in NAMES:
        direction = torch.randn(double[name].shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        h = 1e-6
        ends = [loss(name, double[name] + s * h * direction) for s in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * h)
        along = float((getattr(found, name).cpu().double() * direction).sum())
        assert along == pytest.approx(difference, rel=2e-4, abs=1e-3), name


def test_closed_form_profile(to):
    """Isotropic 1 cm Gaussian on the axis at 2 m, fx 600: variance 9.3 px^2, alpha o exp(-d^2 / 18.6)."""
    camera = Camera(width=33, height=33, fx=600.0, fy=600.0, cx=16.5, cy=16.5)
    params = GaussianParams(
        xyz_W=torch.tensor([[0.0, 0.0, 2.0]]),
        log_scale=torch.full((1, 3), 0.01).log(),
        quat=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacity_logit=torch.zeros(1),
        sh=torch.ones(1, 1, 3),
    )
    with use_backend("cuda"):
        out, _ = render_forward(to(params), camera, torch.eye(4))
    expected = [0.5, 0.473828, 0.403249, 0.308196, 0.130389]
    assert [out.alpha[16, 16 + d].item() for d in (0, 1, 2, 3, 5)] == pytest.approx(expected, abs=2e-6)


def test_a_wall_stops_the_light_and_hits_go_on_behind_it(to):
    """Three walls of alpha 0.99, 0.99, 0.99: the third would leave 1e-6 of the light, and so is not blended."""
    n = 3
    camera = Camera(width=16, height=16, fx=16.0, fy=16.0, cx=8.0, cy=8.0)
    params = GaussianParams(
        xyz_W=torch.tensor([[0.0, 0.0, 1.0 + i] for i in range(n)]),
        log_scale=torch.full((n, 3), 3.0),
        quat=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
        opacity_logit=torch.tensor([0.0, 0.5, 20.0]),
        sh=torch.ones(n, 1, 3),
    )
    theirs, _ = render_forward.reference(params, camera, torch.eye(4), opaque_alpha=0.9)
    with use_backend("cuda"):
        ours, _ = render_forward(to(params), camera, torch.eye(4), opaque_alpha=0.9)
    assert (ours.hit_index == 2).all()
    for name in INDICES:
        assert torch.equal(getattr(ours, name).cpu(), getattr(theirs, name))


def test_large_gaussians_off_the_image(make_scene, make_camera, make_images, pose, to, compare):
    camera, p = make_camera(70, 40), make_scene(30, 0)
    params = GaussianParams(**{**vars(p), "log_scale": p.log_scale + 3.0, "xyz_W": p.xyz_W * 4.0})
    v = make_images(camera)
    theirs, saved = render_forward.reference(params, camera, pose)
    expected = render_vjp.reference(saved, *v)
    with use_backend("cuda"):
        ours, saved = render_forward(to(params), camera, to(pose))
        found = render_vjp(saved, *to(v))
    compare("large Gaussians", "alpha", ours.alpha, theirs.alpha, 1e-4, share=2e-3)
    for name in NAMES:
        compare("large Gaussians", name, getattr(found, name), getattr(expected, name), 1e-3, share=FLIPS)


def test_no_tile_is_listed_in_vain_and_none_is_missing(make_scene, make_camera, pose, to):
    """A tile lists a Gaussian where its alpha reaches 1/255 at a pixel, and hardly anywhere else."""
    camera, params = make_camera(96, 80), make_scene(40, 0)
    with use_backend("cuda"):
        _, saved = render_forward(to(params), camera, to(pose))
    s, lists = saved.splats.cpu(), saved.lists
    x, y = torch.arange(96) + 0.5, torch.arange(80) + 0.5
    listed, needed = torch.zeros(40, 30, dtype=torch.bool), torch.zeros(40, 30, dtype=torch.bool)
    for t in range(30):
        listed[lists.ids[lists.offset[t] : lists.offset[t + 1]].long().cpu(), t] = True
    for g in (saved.depth.cpu() < float("inf")).nonzero()[:, 0].tolist():
        u, v, A, B, C, ln_o = s[g, :6].double()
        dx, dy = x[None] - u, y[:, None] - v
        seen = ln_o - 0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy > torch.tensor(1 / 255.0).double().log()
        needed[g] = seen.view(5, 16, 6, 16).any(3).any(1).flatten()
    assert listed[needed].all()
    assert needed.sum() > 50
    assert (listed & ~needed).sum() <= 0.1 * needed.sum()


def test_strided_parameters_are_packed(make_scene, make_camera, make_images, pose, to, compare):
    camera, params = make_camera(33, 17), make_scene(37, 1)
    strided = {name: torch.stack([value, value], dim=-1)[..., 0] for name, value in vars(params).items()}
    v = make_images(camera)
    with use_backend("cuda"):
        whole, saved = render_forward(to(params), camera, to(pose))
        expected = render_vjp(saved, *to(v))
        ours, saved = render_forward(to(GaussianParams(**strided)), camera, to(pose.T.contiguous().T))
        found = render_vjp(saved, *(x.transpose(0, 1).contiguous().transpose(0, 1) for x in to(v)))
    assert torch.equal(ours.rgb, whole.rgb)
    for name in NAMES:
        compare("strided", name, getattr(found, name), getattr(expected, name), 1e-5)
