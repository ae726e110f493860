"""Factors of learning rates: exact at 0 and 1, the same as another learning rate in between, in both optimisers."""

import dataclasses

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import OptimConfig
from gsfusion_nb.gaussians import Edit, GaussianModel
from gsfusion_nb.optim import RowAdam, adam_step
from gsfusion_nb.types import GaussianParams, Seeds

COLUMNS = ("xyz_W", "log_scale", "quat", "opacity_logit", "sh")


def map_of(generator, n: int = 9) -> GaussianModel:
    model = GaussianModel(sh_degree=1)
    xyz, rgb = (torch.rand(n, 3, generator=generator) for _ in range(2))
    model.append(Seeds.isotropic(xyz, rgb, torch.full((n,), 0.05)))
    return model


def gradients(params: GaussianParams, generator) -> GaussianParams:
    return GaussianParams(**{c: torch.randn(getattr(params, c).shape, generator=generator) for c in COLUMNS})


@pytest.mark.parametrize("backend", ["reference", "auto"])
def test_rows_take_their_part_of_the_step(generator, backend):
    """Against a map with another learning rate for all: 0, the same, a third and twice it."""
    factors = torch.tensor([0.0, 1, 1 / 3, 2, 0, 1, 1 / 3, 2, 1])
    model = map_of(generator)
    all_by = {f: GaussianModel.from_state_dict(model.state_dict()) for f in factors.unique().tolist()}
    model.edit(Edit(rates=dict.fromkeys(COLUMNS, factors)), generator)
    config = OptimConfig()
    with use_backend(backend):
        for _ in range(5):
            g = gradients(model.params, generator)
            adam_step(model, g, config)
            for f, other in all_by.items():
                rates = {name: f * value for name, value in vars(config).items() if name.startswith("lr_")}
                adam_step(other, g, dataclasses.replace(config, **rates))
    for name in COLUMNS:
        for f, other in all_by.items():
            rows = factors == f
            found, expected = getattr(model.params, name)[rows], getattr(other.params, name)[rows]
            if f in (0.0, 1.0):
                assert torch.equal(found, expected), (name, f)
            torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-6)
        assert torch.equal(getattr(model.exp_avg_sq, name), getattr(all_by[1.0].exp_avg_sq, name))


def test_the_rows_of_a_window_take_their_part_too(generator):
    params = map_of(generator).params
    rates = {"xyz_W": 0.1, "log_scale": 0.1, "quat": 0.0, "sh_dc": 0.1, "sh_rest": 0.1}
    whole, part = (GaussianParams(**{c: getattr(params, c).clone() for c in COLUMNS}) for _ in range(2))
    factor = torch.tensor([0.0, 1, 0.5] * 3)
    adams = RowAdam(whole, rates), RowAdam(part, rates, {"xyz_W": factor, "quat": factor, "sh": 0 * factor})
    g = gradients(params, generator)
    for adam in adams:
        adam.step(g)
    assert torch.equal(part.sh, params.sh)
    assert torch.equal(part.quat, params.quat)
    assert torch.equal(part.log_scale, whole.log_scale)
    moved, expected = part.xyz_W - params.xyz_W, whole.xyz_W - params.xyz_W
    torch.testing.assert_close(moved, factor[:, None] * expected, atol=1e-6, rtol=0)
    assert torch.equal(moved[1::3], expected[1::3])
