"""Losses that published rules bring, for depth and for the Gaussians, in closed form and by finite differences."""

import math

import pytest
import torch

from gsfusion_nb.optim import add_penalties_, depth_l1, depth_l1_vjp
from gsfusion_nb.optim.map_penalties import (
    anisotropy,
    anisotropy_vjp,
    mean_opacity,
    mean_opacity_vjp,
    mean_scale,
    mean_scale_vjp,
)
from gsfusion_nb.types import GaussianParams

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


def test_penalties_are_added_to_the_gradients(generator):
    n = 5
    shapes = {"xyz_W": (n, 3), "log_scale": (n, 3), "quat": (n, 4), "opacity_logit": (n,), "sh": (n, 1, 3)}
    columns = [{name: torch.randn(*s, generator=generator) for name, s in shapes.items()} for _ in range(2)]
    params, before = (GaussianParams(**c) for c in columns)
    after = GaussianParams(**{name: value.clone() for name, value in columns[1].items()})
    loss = add_penalties_(after, params, isotropy=10.0, scale=0.5, opacity=2.0)
    scale, logit = params.log_scale, params.opacity_logit
    assert loss.item() == pytest.approx(
        float(10 * anisotropy(scale) + 0.5 * mean_scale(scale) + 2 * mean_opacity(logit)), rel=1e-6
    )
    added = anisotropy_vjp(scale, 10.0) + mean_scale_vjp(scale, 0.5)
    torch.testing.assert_close(after.log_scale, before.log_scale + added)
    torch.testing.assert_close(after.opacity_logit, before.opacity_logit + mean_opacity_vjp(logit, 2.0))
    assert torch.equal(after.xyz_W, before.xyz_W)
    assert add_penalties_(after, params, isotropy=0.0, scale=0.0, opacity=0.0) == 0
