"""The loss as printed, its gradient by finite differences and by autograd, and which pixels
count."""

import math

import kornia
import pytest
import torch

from gsfusion_nb.optim import (
    ViewLoss,
    add_penalties_,
    depth_l1,
    depth_l1_vjp,
    dssim,
    dssim_vjp,
    expected_depth_l1,
    expected_depth_l1_vjp,
    l1,
    l1_vjp,
    l2_mse_vjp,
    mse_vjp,
    rgbd_l1_vjp,
)
from gsfusion_nb.optim.penalties import (
    anisotropy,
    anisotropy_vjp,
    mean_opacity,
    mean_opacity_vjp,
    mean_scale,
    mean_scale_vjp,
)
from gsfusion_nb.optim.structural import _ssim_factors, window_mean
from gsfusion_nb.types import GaussianParams


def pair(height: int, width: int, generator: torch.Generator, dtype=torch.float64):
    x = torch.rand(height, width, 3, generator=generator, dtype=dtype)
    return x, (x + 0.2 * torch.randn(height, width, 3, generator=generator, dtype=dtype)).clamp(
        0, 1
    )


def test_l1_by_hand():
    rgb = torch.tensor([[[0.0, 0.5, 1.0]]])
    target = torch.tensor([[[0.5, 0.5, 0.25]]])
    assert l1(rgb, target).item() == pytest.approx(1.25 / 3)
    assert l1_vjp(rgb, target).tolist() == [[[pytest.approx(-1 / 3), 0.0, pytest.approx(1 / 3)]]]


def test_squared_loss_belongs_to_its_gradient_where_the_picture_leaves_its_range():
    rgb = torch.tensor([[[1.5, 0.5, -0.5]]])
    target = torch.tensor([[[1.0, 0.25, 0.0]]])
    loss = l2_mse_vjp(rgb, target)
    assert loss.value.item() == pytest.approx((0.25 + 0.0625 + 0.25) / 3)
    assert loss.mse.item() == pytest.approx(0.0625 / 3)
    assert loss.v_rgb.tolist() == [
        [[pytest.approx(1 / 3), pytest.approx(0.5 / 3), pytest.approx(-1 / 3)]]
    ]


@pytest.mark.parametrize("size", [(1, 1), (5, 4), (17, 13)])
def test_vjps_match_finite_differences(size, generator):
    height, width = size
    x, y = pair(height, width, generator)
    fast = height * width > 50  # along a random direction only, instead of one value after another
    torch.autograd.gradcheck(
        lambda a: dssim(a, y),
        x.clone().requires_grad_(True),
        fast_mode=fast,
    )
    cases = [
        (l1, l1_vjp(x, y)),
        (dssim, dssim_vjp(x, y)[1]),
        (torch.nn.functional.mse_loss, mse_vjp(x, y)),
    ]
    for value, v in cases:
        a = x.clone().requires_grad_(True)
        (expected,) = torch.autograd.grad(value(a, y), a)
        torch.testing.assert_close(v, expected)


def test_dssim_value_is_the_same_with_and_without_gradient(generator):
    x, y = pair(20, 31, generator)
    assert dssim_vjp(x, y)[0] == dssim(x, y)


def test_interior_agrees_with_kornia(generator):
    """Kornia reflects at the border, this loss pads with zeros; 6 px inside they are the same
    function."""
    x, y = pair(64, 48, generator, torch.float32)
    A1, A2, B1, B2 = _ssim_factors(x, y)
    theirs = kornia.metrics.ssim(
        x.permute(2, 0, 1)[None],
        y.permute(2, 0, 1)[None],
        11,
    )[0].permute(1, 2, 0)
    torch.testing.assert_close(
        (A1 * A2 / (B1 * B2))[6:-6, 6:-6],
        theirs[6:-6, 6:-6],
        rtol=1e-5,
        atol=1e-5,
    )


def test_window_is_a_gaussian_that_adds_up_to_one():
    """By the formula, at the middle of an image and at its corner, where pixels beyond the border
    count as zero."""
    weight = [math.exp(-0.5 * (i / 1.5) ** 2) for i in range(-5, 6)]
    share = [w / sum(weight) for w in weight]
    image = torch.zeros(23, 23, 3, dtype=torch.float64)
    image[11, 11] = 1.0
    image[0, 0] = 1.0
    mean = window_mean(image)
    for i in (-5, -2, 0, 4):
        assert float(mean[11 + i, 11, 1]) == pytest.approx(share[5 + i] * share[5], rel=1e-12)
    assert float(mean[0, 0, 2]) == pytest.approx(share[5] ** 2, rel=1e-12)
    assert float(window_mean(torch.ones_like(image))[0, 11, 0]) == pytest.approx(
        sum(share[5:]), rel=1e-12
    )


def pictures(generator, height: int = 5, width: int = 7, dtype=torch.float64):
    """Rendered and measured colour and depth, some depth missing in each."""

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=dtype)

    def holes(depth_m: torch.Tensor) -> torch.Tensor:
        return torch.where(uniform(height, width) < 0.2, 0.0, depth_m)

    rgb = uniform(height, width, 3)
    target_rgb = uniform(height, width, 3)
    depth_m = holes(1 + uniform(height, width))
    target_m = holes(1 + uniform(height, width))
    pixels = uniform(height, width) < 0.7
    return rgb, depth_m, target_rgb, target_m, pixels


def written_out(rgb, depth_m, target_rgb, target_m, pixels, w_c, w_d, behind_m) -> torch.Tensor:
    """Pixel by pixel, term by term."""
    colour = []
    depth = []
    for y in range(rgb.shape[0]):
        for x in range(rgb.shape[1]):
            if not pixels[y, x]:
                continue
            colour.extend((rgb[y, x, c] - target_rgb[y, x, c]).abs() for c in range(3))
            if depth_m[y, x] <= 0 or target_m[y, x] <= 0:
                continue
            if behind_m is None or depth_m[y, x] - target_m[y, x] < behind_m:
                depth.append((depth_m[y, x] - target_m[y, x]).abs())
    return w_c * torch.stack(colour).mean() + w_d * torch.stack(depth).mean()


def test_by_hand():
    rgb = torch.zeros(1, 2, 3)
    target = torch.tensor([[[0.3, 0.0, -0.6], [9.0, 9.0, 9.0]]])
    depth = torch.tensor([[2.5, 1.0]])
    target_m = torch.tensor([[2.0, 9.0]])
    only_first = torch.tensor([[True, False]])
    loss = rgbd_l1_vjp(
        rgb, depth, target, target_m, only_first, weight_colour=0.8, weight_depth=2.0
    )
    assert loss.colour == pytest.approx(0.3)
    assert loss.depth_m == pytest.approx(0.5)
    assert loss.total == pytest.approx(0.8 * 0.3 + 2.0 * 0.5)
    torch.testing.assert_close(
        loss.v_rgb,
        torch.tensor([[[-0.8 / 3, 0.0, 0.8 / 3], [0.0, 0.0, 0.0]]]),
    )
    torch.testing.assert_close(loss.v_depth_m, torch.tensor([[2.0, 0.0]]))


@pytest.mark.parametrize("behind_m", [None, 0.1, -0.2])
@pytest.mark.parametrize("weights", [(1.0, 1.0), (0.8, 0.3), (0.0, 1.0)])
def test_value_and_gradient_of_the_printed_formula(generator, behind_m, weights):
    rgb, depth_m, *rest = pictures(generator)
    target_rgb, target_m, pixels = rest
    leaves = rgb.clone().requires_grad_(), depth_m.clone().requires_grad_()
    expected = written_out(
        leaves[0],
        leaves[1],
        target_rgb,
        target_m,
        pixels,
        weights[0],
        weights[1],
        behind_m,
    )
    expected.backward()
    loss = rgbd_l1_vjp(
        rgb, depth_m, *rest, weight_colour=weights[0], weight_depth=weights[1], behind_m=behind_m
    )
    assert loss.total == pytest.approx(float(expected.detach()), rel=1e-12)
    torch.testing.assert_close(loss.v_rgb, leaves[0].grad)
    torch.testing.assert_close(loss.v_depth_m, leaves[1].grad)


def test_gradient_by_finite_differences(generator):
    rgb, depth_m, *rest = pictures(generator, 3, 4)
    loss = rgbd_l1_vjp(rgb, depth_m, *rest, weight_depth=0.7, behind_m=0.1)
    h = 1e-6
    for image, v in ((rgb, loss.v_rgb), (depth_m, loss.v_depth_m)):
        numeric = torch.zeros_like(image)
        for i in range(image.numel()):
            if image is depth_m and depth_m.flatten()[i] == 0:
                continue  # a pixel without a disc is not on the curve
            ends = []
            for step in (h, -h):
                shifted = image.clone()
                shifted.view(-1)[i] += step
                both = (shifted, depth_m) if image is rgb else (rgb, shifted)
                ends.append(rgbd_l1_vjp(*both, *rest, weight_depth=0.7, behind_m=0.1).total)
            numeric.view(-1)[i] = (ends[0] - ends[1]) / (2 * h)
        torch.testing.assert_close(v, numeric, atol=1e-8, rtol=1e-6)


def test_no_pixels_no_loss(generator):
    rgb, depth_m, target, target_m, pixels = pictures(generator)
    loss = rgbd_l1_vjp(rgb, depth_m, target, target_m, torch.zeros_like(pixels))
    assert (loss.colour, loss.depth_m, loss.total) == (0.0, 0.0, 0.0)
    assert not loss.v_rgb.any()
    assert not loss.v_depth_m.any()


@pytest.mark.parametrize("missing", ["rendered", "measured"])
def test_without_depth_only_colour_counts(generator, missing):
    rgb, depth_m, target, target_m, pixels = pictures(generator)
    nothing = torch.zeros_like(depth_m)
    depths = (nothing, target_m) if missing == "rendered" else (depth_m, nothing)
    loss = rgbd_l1_vjp(rgb, depths[0], target, depths[1], pixels)
    assert loss.depth_m == 0.0
    assert loss.total == loss.colour > 0
    assert not loss.v_depth_m.any()


def test_far_behind_the_measurement_does_not_count_but_far_in_front_does():
    depth = torch.tensor([[2.05, 2.2, 1.0]])
    target_m = torch.full((1, 3), 2.0)
    rgb = torch.zeros(1, 3, 3)
    loss = rgbd_l1_vjp(
        rgb,
        depth,
        rgb,
        target_m,
        torch.ones(1, 3, dtype=torch.bool),
        behind_m=0.1,
    )
    assert loss.depth_m == pytest.approx((0.05 + 1.0) / 2)
    torch.testing.assert_close(loss.v_depth_m, torch.tensor([[0.5, 0.0, -0.5]]))


PENALTIES = [
    (anisotropy, anisotropy_vjp, (7, 3)),
    (mean_scale, mean_scale_vjp, (7, 3)),
    (mean_opacity, mean_opacity_vjp, (7,)),
]


@pytest.mark.parametrize(("penalty", "vjp", "shape"), PENALTIES)
def test_gradients_match_finite_differences(penalty, vjp, shape, generator):
    x = torch.randn(*shape, generator=generator, dtype=torch.float64)
    torch.autograd.gradcheck(penalty, x.clone().requires_grad_(True))
    a = x.clone().requires_grad_(True)
    (expected,) = torch.autograd.grad(penalty(a), a)
    torch.testing.assert_close(vjp(x), expected)
    torch.testing.assert_close(vjp(x, 2.5), 2.5 * expected)
    assert penalty(x[:0]) == 0
    assert vjp(x[:0]).shape == x[:0].shape


def test_penalties_by_hand():
    log_scale = torch.tensor([[1.0, 2.0, 3.0], [5.0, 5.0, 5.0]]).log()
    assert anisotropy(log_scale).item() == pytest.approx((1 + 0 + 1) / 6)
    assert mean_scale(log_scale).item() == pytest.approx(21 / 6)
    assert mean_opacity(torch.tensor([0.0, math.log(3)])).item() == pytest.approx((0.5 + 0.75) / 2)
    round_ones = torch.full((4, 3), math.log(0.0123))
    assert anisotropy_vjp(round_ones).abs().max() == 0


def test_depth_counts_where_it_is_measured(generator):
    depth = torch.tensor([[1.0, 2.0], [3.0, 0.0]], dtype=torch.float64)
    target = torch.tensor([[1.5, 0.0], [2.0, 4.0]], dtype=torch.float64)
    assert depth_l1(depth, target).item() == pytest.approx((0.5 + 1 + 4) / 3)
    assert depth_l1_vjp(depth, target, 3.0).tolist() == [[-1.0, 0.0], [1.0, -1.0]]
    torch.autograd.gradcheck(lambda d: depth_l1(d, target), depth.clone().requires_grad_(True))
    assert depth_l1(depth, torch.zeros_like(target)) == 0


def test_depth_over_alpha_by_hand():
    """Pixels: right where alpha is 0.8, too near, not measured, hardly covered (divided by 1/2)."""
    depth = torch.tensor([1.6, 0.9, 7.0, 0.1], dtype=torch.float64)[None]
    alpha = torch.tensor([0.8, 0.9, 0.9, 0.25], dtype=torch.float64)[None]
    target = torch.tensor([2.0, 4.0, 0.0, 2.0], dtype=torch.float64)[None]
    assert expected_depth_l1(depth, alpha, target).item() == pytest.approx((0 + 3 + 1.8) / 3)
    holes = (2 * 0.2 + 4 * 0.1 + 2 * 0.75) / 3
    covered = expected_depth_l1(depth, alpha, target, 0.5).item()
    assert covered == pytest.approx((0 + 3 + 1.8) / 3 + 0.5 * holes)
    v_depth, v_alpha = expected_depth_l1_vjp(depth, alpha, target, 0.5, v_loss=3.0)
    assert v_depth[0, 1:].tolist() == pytest.approx([-1 / 0.9, 0, -2])
    assert v_alpha[0, 1:].tolist() == pytest.approx([0.9 / 0.81 - 0.5 * 4, 0, -0.5 * 2])
    assert expected_depth_l1(depth, alpha, torch.zeros_like(target)) == 0


def test_depth_beyond_what_is_mapped_counts_less():
    """Twice as far as ``far_m``: a quarter."""
    depth = torch.tensor([[3.0, 3.0]], dtype=torch.float64)
    target = torch.tensor([[2.0, 4.0]], dtype=torch.float64)
    alpha = torch.tensor([[1.0, 0.5]], dtype=torch.float64)
    loss = expected_depth_l1(depth, alpha, target, 0.5, far_m=2.0)
    assert loss.item() == pytest.approx((1 + (2 + 0.5 * 4 * 0.5) / 4) / 2)
    every, every_alpha = expected_depth_l1_vjp(depth, alpha, target, 0.5)
    v_depth, v_alpha = expected_depth_l1_vjp(depth, alpha, target, 0.5, far_m=2.0)
    assert torch.equal(v_depth, every * torch.tensor([1, 0.25], dtype=torch.float64))
    assert torch.equal(v_alpha, every_alpha * torch.tensor([1, 0.25], dtype=torch.float64))


@pytest.mark.parametrize(("coverage", "far_m"), [(0.0, math.inf), (0.3, math.inf), (0.3, 1.2)])
def test_gradient_of_depth_over_alpha(generator, coverage, far_m):
    alpha = torch.rand(6, 5, dtype=torch.float64, generator=generator)
    depth = 3 * torch.rand(6, 5, dtype=torch.float64, generator=generator)
    target = (3 * torch.rand(6, 5, dtype=torch.float64, generator=generator) - 0.5).clamp_min(0)
    assert (alpha < 0.5).any()
    assert (target == 0).any()
    inputs = (depth.clone().requires_grad_(True), alpha.clone().requires_grad_(True))
    options = (target, coverage, far_m)
    torch.autograd.gradcheck(lambda d, a: expected_depth_l1(d, a, *options), inputs)
    loss = 2.5 * expected_depth_l1(*inputs, *options)
    by_torch = torch.autograd.grad(loss, inputs)
    by_hand = expected_depth_l1_vjp(depth, alpha, *options, v_loss=2.5)
    for ours, found in zip(by_hand, by_torch, strict=True):
        torch.testing.assert_close(ours, found)


def test_penalties_are_added_to_the_gradients(generator):
    n = 5
    shapes = {
        "xyz_W": (n, 3),
        "log_scale": (n, 3),
        "quat": (n, 4),
        "opacity_logit": (n,),
        "sh": (n, 1, 3),
    }
    columns = [
        {name: torch.randn(*s, generator=generator) for name, s in shapes.items()} for _ in range(2)
    ]
    params, before = (GaussianParams(**c) for c in columns)
    after = GaussianParams(**{name: value.clone() for name, value in columns[1].items()})
    loss = add_penalties_(after, params, isotropy=10.0, scale=0.5, opacity=2.0)
    scale = params.log_scale
    logit = params.opacity_logit
    assert loss.item() == pytest.approx(
        float(10 * anisotropy(scale) + 0.5 * mean_scale(scale) + 2 * mean_opacity(logit)),
        rel=1e-6,
    )
    added = anisotropy_vjp(scale, 10.0) + mean_scale_vjp(scale, 0.5)
    torch.testing.assert_close(after.log_scale, before.log_scale + added)
    torch.testing.assert_close(
        after.opacity_logit, before.opacity_logit + mean_opacity_vjp(logit, 2.0)
    )
    assert torch.equal(after.xyz_W, before.xyz_W)
    assert add_penalties_(after, params, isotropy=0.0, scale=0.0, opacity=0.0) == 0


def test_equal_images_have_no_dssim(generator):
    x, _ = pair(20, 31, generator)
    loss, v = dssim_vjp(x, x)
    assert loss.item() == pytest.approx(0, abs=1e-12)
    assert v.abs().max() < 1e-12


def test_equal_images_have_no_gradient(generator):
    rgb, depth_m, _, _, pixels = pictures(generator)
    loss = rgbd_l1_vjp(rgb, depth_m, rgb, depth_m, pixels)
    assert loss.total == 0.0
    assert not loss.v_rgb.any()
    assert not loss.v_depth_m.any()


def test_values_outside_the_mask_may_be_anything(generator):
    rgb, depth_m, target, target_m, pixels = pictures(generator)
    clean = rgbd_l1_vjp(rgb, depth_m, target, target_m, pixels)
    rgb[~pixels] = math.nan
    loss = rgbd_l1_vjp(rgb, depth_m, target, target_m, pixels)
    assert loss.total == clean.total
    assert torch.equal(loss.v_rgb, clean.v_rgb)


@pytest.mark.parametrize("with_depth", [False, True])
def test_a_loss_without_its_graph(with_depth):
    """In the type of the picture, as numbers only."""
    given = torch.rand(2, 3, 3, dtype=torch.float64, requires_grad=True)
    depth = given[..., 0] * 2 if with_depth else None
    loss = ViewLoss(value=given.sum(), v_rgb=2 * given, v_depth_m=depth).detached(torch.zeros(1))
    assert loss.v_rgb.dtype == loss.value.dtype == torch.float32
    assert not loss.v_rgb.requires_grad
    assert not loss.value.requires_grad
    assert (loss.v_depth_m is not None) == with_depth
    if loss.v_depth_m is not None:
        assert not loss.v_depth_m.requires_grad
        torch.testing.assert_close(loss.v_depth_m, loss.v_rgb[..., 0])
