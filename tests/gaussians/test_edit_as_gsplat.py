"""The operations of ``Edit`` against those of gsplat's strategies, on the same map and the same random numbers."""

import math
import warnings
from typing import Any

import pytest
import torch

from gsfusion_nb.gaussians import Edit, GaussianModel
from gsfusion_nb.types import Seeds

NAMES = {"means": "xyz_W", "scales": "log_scale", "quats": "quat", "opacities": "opacity_logit", "sh": "sh"}
N = 12


@pytest.fixture(scope="module")
def ops() -> Any:
    """``gsplat.strategy.ops``, whose CUDA kernel of Eq. 9 is written out in Python here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ops = pytest.importorskip("gsplat.strategy.ops", reason="gsplat is not installed: pip install gsplat==1.5.3")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ops, "compute_relocation", relocation_kernel)
        yield ops


def relocation_kernel(opacities, scales, ratios, binoms):
    """Line by line ``relocation_kernel`` of gsplat's Relocation.cu, in double precision."""
    new_opacities, new_scales = torch.empty_like(opacities), torch.empty_like(scales)
    for idx, n_idx in enumerate(ratios.clamp(1, len(binoms)).tolist()):
        new, denom_sum = 1.0 - (1.0 - float(opacities[idx])) ** (1.0 / n_idx), 0.0
        for i in range(1, n_idx + 1):
            for k in range(i):
                denom_sum += float(binoms[i - 1, k]) * (-1.0) ** k / math.sqrt(k + 1) * new ** (k + 1)
        new_opacities[idx] = new
        new_scales[idx] = float(opacities[idx]) / denom_sum * scales[idx]
    return new_opacities, new_scales


@pytest.fixture
def pair(generator):
    """The same map for both, with moments."""
    model = GaussianModel(sh_degree=1)
    model.append(
        Seeds(
            xyz_W=torch.rand(N, 3, generator=generator),
            rgb=torch.rand(N, 3, generator=generator),
            scale_m=0.01 + torch.rand(N, 3, generator=generator),
            quat=torch.randn(N, 4, generator=generator),
            opacity=0.01 + 0.98 * torch.rand(N, generator=generator),
            tag=torch.zeros(N, dtype=torch.int32),
        )
    )
    params, optimisers = torch.nn.ParameterDict(), {}
    for theirs, ours in NAMES.items():
        params[theirs] = torch.nn.Parameter(getattr(model.params, ours).clone())
        optimisers[theirs] = torch.optim.Adam([params[theirs]], lr=0.0)
        params[theirs].grad = torch.randn(params[theirs].shape, generator=generator)
        optimisers[theirs].step()
        state = optimisers[theirs].state[params[theirs]]
        getattr(model.exp_avg, ours).copy_(state["exp_avg"])
        getattr(model.exp_avg_sq, ours).copy_(state["exp_avg_sq"])
    return model, params, optimisers


def assert_same(model: GaussianModel, params, optimisers, tolerance: float = 1e-6) -> None:
    for theirs, ours in NAMES.items():
        torch.testing.assert_close(getattr(model.params, ours), params[theirs].data, atol=tolerance, rtol=tolerance)
        state = optimisers[theirs].state[params[theirs]]
        for moment in ("exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(getattr(getattr(model, moment), ours), state[moment], atol=0, rtol=0)


def seeded(seed: int = 5) -> torch.Generator:
    """The generator of torch itself, which gsplat draws from, and ours, at the same place."""
    torch.manual_seed(seed)
    return torch.Generator().manual_seed(seed)


def mask(*rows: int) -> torch.Tensor:
    return torch.isin(torch.arange(N), torch.tensor(rows))


BINOMS = torch.tensor([[math.comb(n, k) for k in range(51)] for n in range(51)])


def test_duplicate(ops, pair):
    model, params, optimisers = pair
    model.edit(Edit(clone=mask(3, 4, 9)), torch.Generator())
    ops.duplicate(params, optimisers, {}, mask(3, 4, 9))
    assert_same(model, params, optimisers)


@pytest.mark.parametrize("shares", [False, True])
def test_split(ops, pair, shares):
    model, params, optimisers = pair
    generator = seeded()
    model.edit(Edit(split=mask(0, 5, 6), split_shares=shares), generator)
    ops.split(params, optimisers, {}, mask(0, 5, 6), revised_opacity=shares)
    assert_same(model, params, optimisers)


def test_remove(ops, pair):
    model, params, optimisers = pair
    model.edit(Edit(keep=~mask(0, 11)), torch.Generator())
    ops.remove(params, optimisers, {}, mask(0, 11))
    assert_same(model, params, optimisers)


def test_reset_opacity(ops, pair):
    model, params, optimisers = pair
    model.edit(Edit(reset_opacity=0.3), torch.Generator())
    ops.reset_opa(params, optimisers, {}, 0.3)
    assert_same(model, params, optimisers)


def test_relocate(ops, pair):
    model, params, optimisers = pair
    dead, alive = torch.tensor([1, 2, 8]), mask(1, 2, 8).logical_not().nonzero()[:, 0]
    drawn = torch.multinomial(model.opacity[alive], 3, replacement=True, generator=seeded())
    model.edit(Edit(relocate=(dead, alive[drawn])), torch.Generator())
    ops.relocate(params, optimisers, {}, mask(1, 2, 8), BINOMS)
    assert_same(model, params, optimisers, 1e-5)


def test_sample_add(ops, pair):
    model, params, optimisers = pair
    drawn = torch.multinomial(model.opacity, 20, replacement=True, generator=seeded())
    assert len(drawn.unique()) < 12
    model.edit(Edit(clone=drawn, clone_shares=True), torch.Generator())
    ops.sample_add(params, optimisers, {}, 20, BINOMS)
    assert_same(model, params, optimisers, 1e-5)


def test_grow_as_the_default_strategy_does(ops, pair):
    """Duplicate some, split others, then remove: one edit; the rows come in the same order."""
    model, params, optimisers = pair
    generator = seeded()
    model.edit(Edit(clone=mask(1, 2), split=mask(3, 7), keep=~mask(0)), generator)
    ops.duplicate(params, optimisers, {}, mask(1, 2))
    ops.split(params, optimisers, {}, torch.cat([mask(3, 7), torch.zeros(2, dtype=torch.bool)]))
    ops.remove(params, optimisers, {}, torch.arange(len(params["means"])) == 0)
    assert_same(model, params, optimisers)
