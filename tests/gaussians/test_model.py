import pytest
import torch

from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.gaussians.model import PARAMETERS
from gsfusion_nb.types import Seeds


def seeds(n: int, generator: torch.Generator) -> Seeds:
    def uniform(*size: int):
        return torch.rand(*size, generator=generator)

    return Seeds.isotropic(uniform(n, 3), uniform(n, 3), 0.01 + uniform(n), tag=torch.arange(n))


def test_appended_rows_hold_the_published_initial_values(generator):
    model = GaussianModel(sh_degree=3)
    rgb = torch.tensor([[0.0, 128 / 255, 1.0]])
    model.append(Seeds.isotropic(torch.ones(1, 3), rgb, torch.tensor([0.00745356])), frame_index=7)
    p = model.params
    # -0.5 / 0.28209479177387814 and log(2 * sqrt(2^2 + 1^2) / 600)
    assert p.sh[0, 0].tolist() == pytest.approx([-1.772454, 0.0069508, 1.772454], abs=1e-5)
    assert p.log_scale[0].tolist() == pytest.approx([-4.899064] * 3, abs=1e-5)
    assert p.opacity_logit.tolist() == [0.0]
    assert p.quat.tolist() == [[1.0, 0.0, 0.0, 0.0]]
    assert p.sh[0, 1:].abs().max() == 0
    assert p.sh_degree == 3
    assert model.birth_frame.tolist() == [7]


@pytest.mark.parametrize("counts", [(0,), (1,), (4096, 1), (5000, 5000, 3)])
def test_growth_keeps_old_rows_and_zeroes_new_moments(counts, generator):
    model = GaussianModel(sh_degree=1)
    parts = [seeds(n, generator) for n in counts]
    for i, part in enumerate(parts):
        model.append(part, i)
        for name in PARAMETERS:
            getattr(model.exp_avg, name)[:] += 1.0
    assert len(model) == sum(counts)
    torch.testing.assert_close(model.params.xyz_W, torch.cat([p.xyz_W for p in parts]))
    torch.testing.assert_close(model.scale_m, torch.cat([p.scale_m for p in parts]))
    expected = torch.cat([torch.full((n,), float(len(counts) - i)) for i, n in enumerate(counts)])
    torch.testing.assert_close(model.exp_avg.opacity_logit, expected)


def test_keep_filters_every_column_alike(generator):
    model = GaussianModel(sh_degree=2)
    all_seeds = seeds(50, generator)
    model.append(all_seeds, 3)
    model.exp_avg.xyz_W.copy_(all_seeds.xyz_W)
    rows = torch.rand(50, generator=generator) > 0.5
    model.keep(rows)
    assert len(model) == int(rows.sum())
    torch.testing.assert_close(model.params.xyz_W, all_seeds.xyz_W[rows])
    torch.testing.assert_close(model.exp_avg.xyz_W, all_seeds.xyz_W[rows])
    assert model.tag.tolist() == rows.nonzero()[:, 0].tolist()


def test_state_round_trip(generator):
    model = GaussianModel(sh_degree=1)
    model.append(seeds(5000, generator), 2)
    model.step_count = 17
    again = GaussianModel.from_state_dict(model.state_dict())
    assert again.step_count == 17
    for name in PARAMETERS:
        assert torch.equal(getattr(again.params, name), getattr(model.params, name))
        assert torch.equal(getattr(again.exp_avg_sq, name), getattr(model.exp_avg_sq, name))
