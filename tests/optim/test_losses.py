import kornia
import pytest
import torch

from gsfusion_nb.optim import dssim, dssim_vjp, l1, l1_vjp


def pair(height: int, width: int, generator: torch.Generator, dtype=torch.float64):
    x = torch.rand(height, width, 3, generator=generator, dtype=dtype)
    return x, (x + 0.2 * torch.randn(height, width, 3, generator=generator, dtype=dtype)).clamp(0, 1)


def test_l1_by_hand():
    rgb = torch.tensor([[[0.0, 0.5, 1.0]]])
    target = torch.tensor([[[0.5, 0.5, 0.25]]])
    assert l1(rgb, target).item() == pytest.approx(1.25 / 3)
    assert l1_vjp(rgb, target).tolist() == [[[pytest.approx(-1 / 3), 0.0, pytest.approx(1 / 3)]]]


@pytest.mark.parametrize("size", [(1, 1), (5, 4), (17, 13)])
def test_vjps_match_finite_differences(size, generator):
    height, width = size
    x, y = pair(height, width, generator)
    torch.autograd.gradcheck(lambda a: dssim(a, y), x.clone().requires_grad_(True))
    for value, v in ((lambda a: l1(a, y), l1_vjp(x, y)), (lambda a: dssim(a, y), dssim_vjp(x, y)[1])):
        a = x.clone().requires_grad_(True)
        (expected,) = torch.autograd.grad(value(a), a)
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
    from gsfusion_nb.optim.losses import _ssim_terms

    ours = _ssim_terms(x, y)[0]
    theirs = kornia.metrics.ssim(x.permute(2, 0, 1)[None], y.permute(2, 0, 1)[None], 11)
    torch.testing.assert_close(ours[..., 6:-6, 6:-6], theirs[..., 6:-6, 6:-6], rtol=1e-5, atol=1e-5)
