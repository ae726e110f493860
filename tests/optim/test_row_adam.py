"""Adam with one constant rate per group, against torch's."""

import pytest
import torch

from gsfusion_nb.gaussians.model import PARAMETERS
from gsfusion_nb.optim import RowAdam
from gsfusion_nb.types import GaussianParams

RATES = {"xyz_W": 1e-3, "log_scale": 4e-3, "quat": 2e-3, "sh_dc": 5e-4, "sh_rest": 2.5e-5}


def rows(n: int, generator: torch.Generator, dtype=torch.float32) -> GaussianParams:
    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=dtype)

    return GaussianParams(
        xyz_W=normal(n, 3), log_scale=normal(n, 3), quat=normal(n, 4), opacity_logit=normal(n), sh=normal(n, 9, 3)
    )


def copy(params: GaussianParams) -> GaussianParams:
    return GaussianParams(**{name: value.clone() for name, value in vars(params).items()})


@pytest.mark.parametrize("n", [0, 1, 11])
def test_twenty_steps_of_torch_adam(n, generator):
    params = rows(n, generator)
    leaves = {name: value.clone().requires_grad_() for name, value in vars(params).items() if name != "sh"}
    leaves |= {"sh_dc": params.sh[:, :1].clone().requires_grad_(), "sh_rest": params.sh[:, 1:].clone().requires_grad_()}
    groups = [{"params": [leaves[name]], "lr": lr} for name, lr in RATES.items()]
    theirs = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15)
    born = params.opacity_logit.clone()
    ours = RowAdam(params, RATES)
    for step in range(20):
        g = rows(n, generator)
        if step % 3 == 0:
            g.xyz_W[: n // 2] = 0.0  # rows that this view does not show
        for name, leaf in leaves.items():
            leaf.grad = {"sh_dc": g.sh[:, :1], "sh_rest": g.sh[:, 1:]}.get(name, getattr(g, name, None))
        theirs.step()
        ours.step(g)
    for name in ("xyz_W", "log_scale", "quat"):
        torch.testing.assert_close(getattr(params, name), leaves[name].detach(), atol=1e-6, rtol=0)
    torch.testing.assert_close(params.sh[:, :1], leaves["sh_dc"].detach(), atol=1e-6, rtol=0)
    torch.testing.assert_close(params.sh[:, 1:], leaves["sh_rest"].detach(), atol=1e-6, rtol=0)
    assert torch.equal(params.opacity_logit, born)


@pytest.mark.parametrize("still", [("xyz_W",), ("xyz_W", "log_scale", "quat"), ("sh_dc", "sh_rest")])
def test_groups_at_rate_zero_are_left_alone(still, generator):
    params = rows(4, generator)
    before = copy(params)
    adam = RowAdam(params, RATES | dict.fromkeys(still, 0.0))
    for _ in range(5):
        adam.step(rows(4, generator))
    unmoved = {name for name in PARAMETERS if torch.equal(getattr(params, name), getattr(before, name))}
    expected = set(still) & set(PARAMETERS) | {"opacity_logit"} | ({"sh"} if "sh_dc" in still else set())
    assert unmoved == expected


def test_no_gradient_moves_nothing(generator):
    params = rows(3, generator)
    before = copy(params)
    adam = RowAdam(params, RATES)
    for _ in range(3):
        adam.step(GaussianParams(**{name: torch.zeros_like(value) for name, value in vars(params).items()}))
    for name in PARAMETERS:
        assert torch.equal(getattr(params, name), getattr(before, name))


def test_gradients_may_have_more_rows(generator):
    """The optimiser works on the first rows of the picture's Gaussians; those behind are frozen."""
    params = rows(5, generator)
    part, alone = copy(params), copy(params[:2])
    g = rows(5, generator)
    RowAdam(part[:2], RATES).step(g)
    RowAdam(alone, RATES).step(g[:2])
    for name in PARAMETERS:
        assert torch.equal(getattr(part, name)[:2], getattr(alone, name))
        assert torch.equal(getattr(part, name)[2:], getattr(params, name)[2:])


def test_state_round_trip(generator):
    params = rows(6, generator)
    gradients = [rows(6, generator) for _ in range(8)]
    whole, parted = RowAdam(copy(params), RATES), RowAdam(copy(params), RATES)
    for g in gradients[:4]:
        whole.step(g)
        parted.step(g)
    state = parted.state_dict()
    resumed = RowAdam(copy(parted.params), RATES)
    parted.step(gradients[0])  # what was saved stays as it was
    resumed.load_state_dict(state)
    for g in gradients[4:]:
        whole.step(g)
        resumed.step(g)
    for name in PARAMETERS:
        assert torch.equal(getattr(whole.params, name), getattr(resumed.params, name))
    assert resumed.steps == 8
