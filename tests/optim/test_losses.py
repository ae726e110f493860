import math

import kornia
import pytest
import torch

from gsfusion_nb.optim import dssim, dssim_vjp, l1, l1_vjp, l2_mse_vjp, mse_vjp
from gsfusion_nb.optim.losses import _ssim_factors, window_mean


def pair(height: int, width: int, generator: torch.Generator, dtype=torch.float64):
    x = torch.rand(height, width, 3, generator=generator, dtype=dtype)
    return x, (x + 0.2 * torch.randn(height, width, 3, generator=generator, dtype=dtype)).clamp(0, 1)


def test_l1_by_hand():
    rgb = torch.tensor([[[0.0, 0.5, 1.0]]])
    target = torch.tensor([[[0.5, 0.5, 0.25]]])
    assert l1(rgb, target).item() == pytest.approx(1.25 / 3)
    assert l1_vjp(rgb, target).tolist() == [[[pytest.approx(-1 / 3), 0.0, pytest.approx(1 / 3)]]]


def test_squared_loss_belongs_to_its_gradient_where_the_picture_leaves_its_range():
    rgb, target = torch.tensor([[[1.5, 0.5, -0.5]]]), torch.tensor([[[1.0, 0.25, 0.0]]])
    loss = l2_mse_vjp(rgb, target)
    assert loss.value.item() == pytest.approx((0.25 + 0.0625 + 0.25) / 3)
    assert loss.mse.item() == pytest.approx(0.0625 / 3)
    assert loss.v_rgb.tolist() == [[[pytest.approx(1 / 3), pytest.approx(0.5 / 3), pytest.approx(-1 / 3)]]]


@pytest.mark.parametrize("size", [(1, 1), (5, 4), (17, 13)])
def test_vjps_match_finite_differences(size, generator):
    height, width = size
    x, y = pair(height, width, generator)
    fast = height * width > 50  # along a random direction only, instead of one value after another
    torch.autograd.gradcheck(lambda a: dssim(a, y), x.clone().requires_grad_(True), fast_mode=fast)
    cases = [(l1, l1_vjp(x, y)), (dssim, dssim_vjp(x, y)[1]), (torch.nn.functional.mse_loss, mse_vjp(x, y))]
    for value, v in cases:
        a = x.clone().requires_grad_(True)
        (expected,) = torch.autograd.grad(value(a, y), a)
        torch.testing.assert_close(v, expected)


def test_dssim_value_is_the_same_with_and_without_gradient(generator):
    x, y = pair(20, 31, generator)
    assert dssim_vjp(x, y)[0] == dssim(x, y)


def test_equal_images_have_no_dssim(generator):
    x, _ = pair(20, 31, generator)
    loss, v = dssim_vjp(x, x)
    assert loss.item() == pytest.approx(0, abs=1e-12)
    assert v.abs().max() < 1e-12


def test_interior_agrees_with_kornia(generator):
    """Kornia reflects at the border, this loss pads with zeros; 6 px inside they are the same function."""
    x, y = pair(64, 48, generator, torch.float32)
    A1, A2, B1, B2 = _ssim_factors(x, y)
    theirs = kornia.metrics.ssim(x.permute(2, 0, 1)[None], y.permute(2, 0, 1)[None], 11)[0].permute(1, 2, 0)
    torch.testing.assert_close((A1 * A2 / (B1 * B2))[6:-6, 6:-6], theirs[6:-6, 6:-6], rtol=1e-5, atol=1e-5)


def test_window_is_a_gaussian_that_adds_up_to_one():
    """By the formula, at the middle of an image and at its corner, where pixels beyond the border count as zero."""
    weight = [math.exp(-0.5 * (i / 1.5) ** 2) for i in range(-5, 6)]
    share = [w / sum(weight) for w in weight]
    image = torch.zeros(23, 23, 3, dtype=torch.float64)
    image[11, 11], image[0, 0] = 1.0, 1.0
    mean = window_mean(image)
    for i in (-5, -2, 0, 4):
        assert float(mean[11 + i, 11, 1]) == pytest.approx(share[5 + i] * share[5], rel=1e-12)
    assert float(mean[0, 0, 2]) == pytest.approx(share[5] ** 2, rel=1e-12)
    assert float(window_mean(torch.ones_like(image))[0, 11, 0]) == pytest.approx(sum(share[5:]), rel=1e-12)
