"""No change of a map is missed: whatever changes a tensor in place changes its count."""

import re
from pathlib import Path

import pytest
import torch

import gsfusion_nb
from gsfusion_nb.backends import offered, use_backend
from gsfusion_nb.config import OptimConfig
from gsfusion_nb.edit_count import edit_count, is_counted
from gsfusion_nb.gaussians import Edit, GaussianModel, restart_optimiser
from gsfusion_nb.gaussians.rigid_motion import move_map_
from gsfusion_nb.large_maps import MapPart
from gsfusion_nb.large_maps.map_part import edits_of
from gsfusion_nb.optim import adam_step, take_missed_steps
from gsfusion_nb.types import GaussianParams, Seeds

WAYS = {
    "operation": lambda x: x.add_(1.0),
    "index": lambda x: x.__setitem__(0, 5.0),
    "mask": lambda x: x.__setitem__(x < 2, 7.0),
    "view": lambda x: x[2:].mul_(3.0),
    "view of a view": lambda x: x.view(-1)[1:][0].fill_(4.0),
    "detached": lambda x: x.detach().zero_(),
    "out": lambda x: torch.add(x, 1.0, out=x),
    "rows": lambda x: x.index_copy_(0, torch.tensor([1]), torch.zeros(1, *x.shape[1:])),
    "another tensor": lambda x: torch.nn.init.ones_(x),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("mode", [torch.no_grad, torch.enable_grad, torch.inference_mode])
def test_every_change_in_place_is_counted(way, mode):
    x = torch.arange(6.0).reshape(3, 2)
    before = edit_count(x, x.clone()[:1])[2]
    assert edit_count(x) == edit_count(x)
    count = edit_count(x)
    with mode():
        WAYS[way](x)
    assert edit_count(x) != count
    assert before == 0


def test_a_tensor_in_another_place_and_one_that_is_not_counted_are_changed_ones():
    x = torch.zeros(3)
    assert edit_count(x) != edit_count(x.clone())
    with torch.inference_mode():
        y = torch.zeros(3)
    assert is_counted(x)
    assert not is_counted(y)
    assert edit_count(y) != edit_count(y)


def seeds(n: int) -> Seeds:
    return Seeds(
        xyz_W=torch.rand(n, 3),
        scale_m=torch.full((n, 3), 0.01),
        quat=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        rgb=torch.rand(n, 3),
        opacity=torch.full((n,), 0.5),
        tag=torch.zeros(n, dtype=torch.int32),
    )


def grown() -> GaussianModel:
    model = GaussianModel(1)
    model.append(seeds(6))
    return model


def like(params: GaussianParams) -> GaussianParams:
    return GaussianParams(**{name: torch.ones_like(x) for name, x in vars(params).items()})


def part_step(model: GaussianModel) -> None:
    part = MapPart(model, torch.tensor([1, 4]))
    adam_step(part, like(part.params), OptimConfig())
    part.write_back()


def late_steps(model: GaussianModel) -> None:
    model.moments.exp_avg.xyz_W.fill_(1.0)
    model.moments.exp_avg_sq.xyz_W.fill_(1.0)
    part_step(model)
    edits = edits_of(model)
    take_missed_steps(model, OptimConfig())
    assert edits_of(model) != edits


def undo(model: GaussianModel) -> None:
    take_back = model.undo_log.begin()
    model.undo_log.will_change()
    model.params.xyz_W.add_(1.0)
    edits = edits_of(model)
    take_back()
    assert edits_of(model) != edits


CHANGES = {
    "append": lambda m: m.append(seeds(1)),
    "grow": lambda m: m.append(seeds(5000)),
    "extend": lambda m: m.extend(m.params[:2]),
    "keep": lambda m: m.keep(torch.arange(6) != 2),
    "copy": lambda m: m.columns.copy_rows(torch.tensor([0])),
    "edit": lambda m: m.edit(Edit(keep=torch.arange(6) != 5), torch.Generator()),
    "set": lambda m: m.set_rows("xyz_W", torch.tensor([0]), torch.ones(1, 3)),
    "rate": lambda m: m.rates.use("xyz_W"),
    "move": lambda m: move_map_(m, 2 * torch.eye(4).repeat(6, 1, 1)),
    "restart": lambda m: restart_optimiser(m),
    "step": lambda m: adam_step(m, like(m.params), OptimConfig()),
    "step on all rows": lambda m: adam_step(MapPart(m), like(m.params), OptimConfig()),
    "step on a part": part_step,
    "missed steps": late_steps,
    "undo": undo,
}


@pytest.mark.parametrize("change", CHANGES)
def test_whatever_changes_a_map_changes_its_edits(change):
    model = grown()
    edits = edits_of(model)
    assert edits_of(model) == edits
    CHANGES[change](model)
    assert edits_of(model) != edits


@pytest.mark.parametrize("backend", offered("adam_update"))
def test_a_kernel_that_writes_past_pytorch_says_so(backend):
    if backend not in ("reference", "numba"):
        pytest.skip("needs a GPU")
    model = grown()
    before = model.params.xyz_W.clone()
    count = edit_count(model.params.xyz_W, model.params.log_scale)
    with use_backend(backend):
        adam_step(model, like(model.params), OptimConfig())
    assert not torch.equal(model.params.xyz_W, before)
    after = edit_count(model.params.xyz_W, model.params.log_scale)
    assert after[2] != count[2]
    assert after[3] != count[3]


def test_one_file_asks_pytorch_for_its_count():
    package = Path(gsfusion_nb.__file__).parent
    asking = [
        path.name
        for path in package.rglob("*.py")
        if re.search(r"\w\._version\b(?!\()", path.read_text(encoding="utf-8"))
    ]
    assert asking == ["edit_count.py"]
