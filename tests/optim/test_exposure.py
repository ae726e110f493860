"""Exposure: its gradient, and the factors that are found."""

import torch

from gsfusion_nb.optim import exposed, exposed_vjp, fit_gain


def test_gradient_against_autograd_and_finite_differences():
    g = torch.Generator().manual_seed(0)
    rgb, v = torch.rand(2, 5, 7, 3, generator=g, dtype=torch.float64)
    gain = torch.tensor([0.8, 1.1, 1.3], dtype=torch.float64)
    v_rgb, v_gain = exposed_vjp(rgb, gain, v)
    x, y = rgb.clone().requires_grad_(), gain.clone().requires_grad_()
    torch.testing.assert_close((v_rgb, v_gain), torch.autograd.grad((exposed(x, y) * v).sum(), (x, y)))
    h = 1e-6
    for c in range(3):
        step = h * torch.eye(3, dtype=torch.float64)[c]
        difference = ((exposed(rgb, gain + step) - exposed(rgb, gain - step)) * v).sum() / (2 * h)
        torch.testing.assert_close(v_gain[c], difference)


def test_the_factors_are_found_where_the_map_shows_something_and_nothing_is_white():
    g = torch.Generator().manual_seed(1)
    rgb = torch.rand(60, 80, 3, generator=g)
    gain = torch.tensor([0.7, 1.2, 1.5])
    target = (rgb * gain).clamp(max=1)
    shown = torch.ones(60, 80, dtype=torch.bool)
    shown[:20] = False
    target[:20] = 0.1
    torch.testing.assert_close(fit_gain(rgb, target, shown), gain, atol=0.02, rtol=0)
    assert torch.equal(fit_gain(rgb, target, ~shown & shown), torch.ones(3))
