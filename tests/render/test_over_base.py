"""Gaussians over a base, blended without order: values in closed form, the gradient three ways, any
order."""

import dataclasses

import pytest
import torch
from three_gaussians import three_gaussians

from gsfusion_nb.geometry.spherical_harmonics import SH_C0
from gsfusion_nb.render import Base, render_over_base, render_over_base_vjp
from gsfusion_nb.render.composite import pixel_offsets, splat_alpha, splat_alpha_vjp
from gsfusion_nb.render.over_base import blend_with_base, blend_with_base_vjp
from gsfusion_nb.render.surface_picture import enlarge, fill, surface_picture
from gsfusion_nb.types import Camera, GaussianParams

BEHIND_M = 0.1


def f64(*values):
    return torch.tensor(values, dtype=torch.float64)


def picture(camera, generator, depth_m=2.0):
    """A base with a hole, in which half of the pixels have no weight."""
    size = (camera.height, camera.width)
    rgb = torch.rand(*size, 3, generator=generator, dtype=torch.float64)
    depth = torch.full(size, depth_m).double()
    weight = torch.ones_like(depth)
    depth[:4, :6] = 0.0
    weight[:4, :3] = 0.0
    return Base(rgb=rgb, depth_m=depth, weight=weight)


def columns(params):
    return [getattr(params, f.name) for f in dataclasses.fields(GaussianParams)]


def test_one_pixel_with_four_gaussians_and_its_gradient_in_numbers():
    """C_s = (.2, .4, .6), D_s = 2, I = (.5, .35, .1), L = mean |C - I|; the fourth Gaussian is 0.2
    m behind."""
    uv = f64(
        [10.9, 7.2],
        [9.0, 8.5],
        [11.5, 7.0],
        [10.5, 7.5],
    )
    z = f64(1.95, 2.05, 2.099, 2.2)
    conic = f64(
        [0.5, 0.1, 0.8],
        [0.2, -0.05, 0.3],
        [1, 0, 1],
        [0.4, 0, 0.4],
    )
    o = f64(0.5, 0.8, 0.9, 0.95)
    c = f64(
        [0.9, 0.1, 0.1],
        [0.2, 0.8, 0.3],
        [0.4, 0.4, 1.2],
        [1, 1, 1],
    )
    dx, dy = pixel_offsets(
        uv,
        torch.tensor([10]),
        torch.tensor([7]),
    )
    alpha = splat_alpha(dx, dy, conic, o)
    w = torch.where(z[:, None] > 2.0 + BEHIND_M, 0.0, alpha)
    assert w[:, 0].tolist() == pytest.approx([0.469002500, 0.510102521, 0.481735286, 0], abs=1e-9)
    b = f64(1.0)
    target = f64([0.5, 0.35, 0.1])
    C, W = blend_with_base(w, c, f64([0.2, 0.4, 0.6]), b)
    assert float(W) == pytest.approx(1.460840307, abs=1e-9)
    assert C[0].tolist() == pytest.approx([0.372562521, 0.425739280, 0.559976747], abs=1e-9)
    v_w, v_c = blend_with_base_vjp(
        w,
        c,
        C,
        b,
        (C - target).sign() / 3,
    )
    assert v_c[:, 1].tolist() == pytest.approx([0.063528774, 0.069095980, 0.065253494, 0], abs=1e-9)
    v_uv, v_conic, v_o = splat_alpha_vjp(
        dx,
        dy,
        conic,
        o,
        alpha,
        torch.where(w > 0, v_w, 0.0),
    )
    assert v_o.tolist() == pytest.approx([-0.166846063, 0.024774925, 0.042548649, 0], abs=1e-9)
    assert v_uv[:3].flatten().tolist() == pytest.approx(
        [0.014181915, -0.016684606, 0.006936979, -0.007432477, -0.038293784, 0.019146892], abs=1e-9
    )
    assert v_conic[1].tolist() == pytest.approx([-0.022297432, 0.029729910, -0.009909970], abs=1e-9)

    # the same pixel as a hole, where nothing is hidden: black with weight 1, or no weight
    black = f64([0.0, 0.0, 0.0])
    C, W = blend_with_base(alpha, c, black, f64(1.0))
    assert float(W) == pytest.approx(2.410840307, abs=1e-9)
    assert C[0].tolist() == pytest.approx([0.488682178, 0.468411370, 0.506623938], abs=1e-9)
    C, _ = blend_with_base(alpha, c, black, f64(0.0))
    assert C[0].tolist() == pytest.approx([0.691384188, 0.662705189, 0.716768068], abs=1e-9)


def test_three_gaussians_in_a_small_picture_and_every_gradient_in_numbers():
    params, camera, T_WC, base, target = three_gaussians(torch.float64)
    out, saved = render_over_base(params, camera, T_WC, base, behind_m=BEHIND_M)
    assert float(out.weight.sum()) == pytest.approx(16.249486960, abs=1e-7)
    assert out.rgb[6, 8].tolist() == pytest.approx(
        [0.367692344, 0.590253845, 0.408757275], abs=2e-9
    )
    assert out.rgb[1, 1].tolist() == [0, 0, 0]
    assert float((out.rgb - target).abs().mean()) == pytest.approx(0.100033292, abs=1e-9)
    g = render_over_base_vjp(saved, (out.rgb - target).sign() / target.numel())
    expected = {
        "xyz_W": f64(
            [0.012060468, -0.002572406, -0.001234682],
            [-0.005346846, 0.001432013, -0.003219389],
            [-0.007886354, 0.006113254, 0.002678328],
        ),
        "log_scale": f64(
            [7.397916e-4, 8.457774e-5, 6.758476e-6],
            [2.199783e-3, 2.760182e-3, 1.664395e-4],
            [-9.431995e-4, -3.582789e-3, -6.643019e-7],
        ),
        "quat": f64(
            [-1.106347e-4, -5.556893e-4, 5.597179e-4, 9.258146e-4],
            [2.026776e-3, 4.119803e-3, -2.724597e-3, -4.323783e-4],
            [0, 9.027493e-5, -1.619190e-4, -7.370364e-4],
        ),
        "opacity_logit": f64(7.537970e-4, 8.594780e-4, -1.602534e-3),
    }
    for name, values in expected.items():
        torch.testing.assert_close(
            getattr(g, name),
            values,
            atol=2e-9,
            rtol=0,
            msg=lambda m, n=name: f"{n}: {m}",
        )
    v_colour = (g.sh[:, 0] / SH_C0).flatten().tolist()
    assert v_colour[:3] == pytest.approx([0.003187185, 0.001282770, -0.003294591], abs=1e-9)


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
    base = picture(camera, generator)

    def pass_of(values):
        rows = GaussianParams(**dict(zip(scene.columns, values, strict=True)))
        return render_over_base(rows, camera, scene.pose, base, behind_m=BEHIND_M)

    scene.finite_difference_check(
        lambda *x: (pass_of(x)[0].rgb,),
        lambda x, v_rgb: tuple(columns(render_over_base_vjp(pass_of(x)[1], v_rgb))),
        columns(params),
        generator,
    )


def test_the_gradient_is_that_of_autograd_on_the_formula(scene, generator):
    """The formula once more, over all pixels and Gaussians at once, with torch's own derivative."""
    from gsfusion_nb.geometry.spherical_harmonics import sh_to_rgb
    from gsfusion_nb.render import project_gaussians

    params = scene.random_map(generator, 30, degree=1, opacity=(0.3, 0.999))
    camera = scene.camera
    base = picture(camera, generator)
    leaves = GaussianParams(
        **{n: getattr(params, n).clone().requires_grad_() for n in scene.columns}
    )
    p = project_gaussians(leaves, camera, scene.pose)
    c = sh_to_rgb(leaves.sh, leaves.xyz_W, scene.pose[:3, 3])
    y, x = (
        at.flatten() for at in torch.meshgrid(torch.arange(19), torch.arange(27), indexing="ij")
    )
    alpha = splat_alpha(*pixel_offsets(p.uv, x, y), p.conic, p.opacity)
    D = base.depth_m.flatten()
    w = alpha * ~((D > 0) & (p.depth_m.detach()[:, None] > D + BEHIND_M))
    total = base.weight.flatten() + w.sum(0)
    C = (base.weight.flatten()[:, None] * base.rgb.flatten(0, 1) + w.T @ c) / total.clamp_min(
        1e-300
    )[:, None]
    v_rgb = torch.randn(19, 27, 3, generator=generator, dtype=torch.float64)
    expected = torch.autograd.grad((C * v_rgb.flatten(0, 1)).sum(), columns(leaves))
    out, saved = render_over_base(params, camera, scene.pose, base, behind_m=BEHIND_M)
    torch.testing.assert_close(out.rgb.flatten(0, 1), C.detach())
    for name, g, e in zip(
        scene.columns, columns(render_over_base_vjp(saved, v_rgb)), expected, strict=True
    ):
        torch.testing.assert_close(
            g, e, atol=1e-9, rtol=1e-8, msg=lambda m, name=name: f"{name}: {m}"
        )


def test_holes_are_filled_by_halving_and_interpolating_by_hand():
    """A row a ? ? b: halved it is a b, halved again (a + b) / 2; going back up nothing of a b is
    missing, and the two pixels in the middle lie at a quarter and three quarters of the way."""
    row = torch.tensor([[[1.0, 8.0], [0.0, 0.0], [0.0, 0.0], [3.0, 0.0]]])
    known = torch.tensor([[True, False, False, True]])
    filled = fill(row, known)
    assert filled[0, :, 0].tolist() == pytest.approx([1.0, 1.5, 2.5, 3.0])
    assert filled[0, :, 1].tolist() == pytest.approx([8.0, 6.0, 2.0, 0.0])
    assert not fill(row, torch.zeros_like(known)).any()
    one = torch.zeros(5, 7, dtype=torch.bool)
    one[3, 2] = True
    torch.testing.assert_close(
        fill(torch.full((5, 7, 1), 0.3), one),
        torch.full((5, 7, 1), 0.3),
    )


def test_enlarging_one_surface_is_bilinear(generator):
    """9/16, 3/16, 3/16 and 1/16 are what PyTorch's interpolation takes; the border is repeated."""
    image = torch.rand(5, 7, 4, generator=generator)
    image[..., 3] = 2 + 0.001 * image[..., 3]
    large, known = enlarge(
        image,
        torch.ones(5, 7, dtype=torch.bool),
        (9, 14),
    )
    chw = image.permute(2, 0, 1)[None]
    expected = torch.nn.functional.interpolate(
        chw, scale_factor=2, mode="bilinear", align_corners=False
    )
    torch.testing.assert_close(large, expected[0].permute(1, 2, 0)[:9])
    assert known.shape == (9, 14)
    assert known.all()


@pytest.mark.parametrize("edge", ["depth", "known"])
def test_colours_do_not_run_over_an_edge(edge):
    """Left of column 3 red, right of it blue: another surface, or one that is not known."""
    image = torch.zeros(4, 6, 4)
    image[:, :3, 0] = image[:, 3:, 2] = 1.0
    image[..., 3] = 2.0
    known = torch.ones(4, 6, dtype=torch.bool)
    if edge == "depth":
        image[:, 3:, 3] = 2.5
    else:
        known[:, 3:] = False
    large, large_known = enlarge(image, known, (8, 12))
    torch.testing.assert_close(large, image.repeat_interleave(2, 0).repeat_interleave(2, 1))
    assert torch.equal(large_known, known.repeat_interleave(2, 0).repeat_interleave(2, 1))


@pytest.mark.parametrize(
    ("holes", "colour", "weight"),
    [("filled", 0.8, 1.0), ("black", 0.0, 1.0), ("gaussians", 0.0, 0.0)],
)
def test_a_hole_in_the_base_is_what_was_asked_for(holes, colour, weight):
    depth_m = torch.full((4, 4), 2.0)
    depth_m[1, 2] = 0.0
    view = surface_picture(
        torch.full((4, 4, 3), 0.8),
        depth_m,
        (4, 4),
        holes,
        0.05,
    )
    hole = torch.zeros(4, 4, dtype=torch.bool)
    hole[1, 2] = True
    torch.testing.assert_close(
        view.base.rgb,
        torch.where(hole[..., None], colour, 0.8).expand(-1, -1, 3),
    )
    torch.testing.assert_close(view.base.weight, torch.where(hole, weight, 1.0))
    assert torch.equal(view.base.depth_m, depth_m)
    torch.testing.assert_close(view.depth_everywhere_m, torch.full((4, 4), 2.0))
    assert view.behind_m == 0.05


@pytest.mark.parametrize(
    ("size", "holes", "behind_m", "sentence"),
    [
        ((4, 5), "black", 0.0, r"as large as the picture \(4, 5\) or half of it, got \(4, 4\)"),
        ((9, 8), "black", 0.0, r"as large as the picture \(9, 8\) or half of it, got \(4, 4\)"),
        ((4, 4), "white", 0.0, "holes must be one of filled, black, gaussians, got 'white'"),
        ((4, 4), "black", -0.1, "behind_m must be >= 0, got -0.1"),
    ],
)
def test_a_base_that_does_not_fit_is_refused(size, holes, behind_m, sentence):
    with pytest.raises(ValueError, match=sentence):
        surface_picture(
            torch.zeros(4, 4, 3),
            torch.ones(4, 4),
            size,
            holes,
            behind_m,
        )


def test_only_rows_that_are_asked_for_have_a_gradient():
    params, camera, T_WC, base, target = three_gaussians(torch.float64)
    out, saved = render_over_base(params, camera, T_WC, base, behind_m=BEHIND_M)
    v_rgb = (out.rgb - target).sign()
    rows = torch.tensor([True, False, True])
    v_uv = torch.zeros(3, 2, dtype=torch.float64)
    v_uv_some = torch.full((3, 2), torch.nan, dtype=torch.float64)
    everything = render_over_base_vjp(saved, v_rgb, v_uv=v_uv)
    some = render_over_base_vjp(saved, v_rgb, rows=rows, v_uv=v_uv_some)
    pairs = [*zip(columns(everything), columns(some), strict=True), (v_uv, v_uv_some)]
    for whole, part in pairs:
        assert whole[1].any()
        assert torch.equal(part[rows], whole[rows])
        assert not part[1].any()


def test_the_absolute_gradient_of_a_centre_is_the_sum_of_what_each_pixel_contributes():
    params, camera, T_WC, base, _ = three_gaussians(torch.float64)
    _, saved = render_over_base(params, camera, T_WC, base, behind_m=BEHIND_M)
    pixels = [(6, 8), (5, 9), (7, 7), (6, 5), (8, 10)]
    v_rgb = torch.zeros(camera.height, camera.width, 3, dtype=torch.float64)
    total = torch.zeros(3, 2, dtype=torch.float64)
    one = torch.zeros(3, 2, dtype=torch.float64)
    for y, x in pixels:
        alone = torch.zeros_like(v_rgb)
        alone[y, x] = v_rgb[y, x] = f64(0.3, -0.2, 0.5)
        render_over_base_vjp(saved, alone, v_uv=one)
        total += one.abs()
    v_uv_abs = torch.zeros_like(total)
    render_over_base_vjp(saved, v_rgb, v_uv_abs=v_uv_abs)
    torch.testing.assert_close(v_uv_abs, total)
    assert (total > 0).all()


def test_a_base_is_a_base():
    params, camera, T_WC, base, _ = three_gaussians(torch.float64)
    with pytest.raises(ValueError, match="base must be a Base, got Tensor"):
        render_over_base.__wrapped__(params, camera, T_WC, base.rgb, behind_m=BEHIND_M)


def test_what_it_refuses(scene, generator):
    params = scene.random_map(generator, 3)
    base = picture(scene.camera, generator)
    for name, bad, message in (
        ("rgb", base.rgb[1:], r"base.rgb must be \[19, 27, 3\], got \[18, 27, 3\]"),
        ("depth_m", base.depth_m.float(), "base.depth_m must be torch.float64"),
    ):
        wrong = object.__new__(Base)  # as after -O: shapes are not checked when it is made
        wrong.__dict__.update(vars(base) | {name: bad})
        with pytest.raises(ValueError, match=message):
            render_over_base(params, scene.camera, scene.pose, wrong, behind_m=BEHIND_M)
    with pytest.raises(ValueError, match="behind_m must be"):
        render_over_base(params, scene.camera, scene.pose, base, behind_m=-1.0)
