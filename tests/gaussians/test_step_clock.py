"""The clock of steps: its invariant, and parts of a map with their missed steps are the whole map,
in any order."""

import copy
import dataclasses
import random
from typing import Any

import pytest
import torch

from gsfusion_nb.config import DiscConfig, OptimConfig, WindowConfig
from gsfusion_nb.gaussians import Edit, GaussianModel, StepClock, SurfelModel, restart_optimiser
from gsfusion_nb.gaussians.model import PARAMETERS
from gsfusion_nb.large_maps import MapPart, params_now
from gsfusion_nb.mapping.surfel_optimiser import SurfelOptimiser
from gsfusion_nb.optim import adam_step, take_missed_steps
from gsfusion_nb.types import GaussianParams, Seeds

CLOSE: dict[str, Any] = {"atol": 1e-5, "rtol": 1e-4}


def seeds(n, generator):
    xyz, rgb, scale = (torch.rand(n, *size, generator=generator) for size in ((3,), (3,), ()))
    return Seeds.isotropic(xyz, rgb, 0.01 + scale)


def gradients(like, seen, generator):
    """Random ones for the rows that are seen, zero for the others."""
    rows = {}
    for name, column in vars(like).items():
        g = torch.zeros_like(column)
        g[seen] = torch.randn(
            len(seen),
            *column.shape[1:],
            generator=generator,
        )
        rows[name] = g
    return GaussianParams(**rows)


class Twins:
    """Two maps of which one is stepped as a whole and one by parts; each operation is done to
    both."""

    def __init__(self, adam_steps, seed):
        self.config = OptimConfig(adam_steps=adam_steps)
        self.random = random.Random(seed)
        self.generator = torch.Generator().manual_seed(seed)
        self.whole = GaussianModel(1)
        self.parts = GaussianModel(1)
        self.append()

    @property
    def both(self):
        return self.whole, self.parts

    def append(self):
        new = seeds(self.random.randint(1, 6), self.generator)
        for model in self.both:
            model.append(new, 1)

    def step(self):
        n = len(self.whole)
        seen = torch.tensor(sorted(self.random.sample(range(n), self.random.randint(1, n))))
        for _ in range(self.random.randint(1, 5)):
            g = gradients(self.whole.params, seen, self.generator)
            adam_step(self.whole, g, self.config)
            part = MapPart(self.parts, seen)
            take_missed_steps(part, self.config)
            part.clock.check()
            adam_step(part, g[seen], self.config)
            part.write_back()

    def step_all(self):
        g = gradients(
            self.whole.params,
            torch.arange(len(self.whole)),
            self.generator,
        )
        take_missed_steps(self.parts, self.config)
        for model in self.both:
            adam_step(model, g, self.config)

    def restart(self):
        take_missed_steps(self.parts, self.config)
        for model in self.both:
            restart_optimiser(model)

    def edit(self):
        take_missed_steps(self.parts, self.config)
        n = len(self.whole)
        keep = torch.rand(n, generator=self.generator) > 0.2
        keep[0] = True
        kept = keep.nonzero()[:, 0]
        rows = kept[torch.randperm(len(kept), generator=self.generator)[: len(kept) // 2]]
        moved = rows[: len(rows) // 2]
        target = rows[len(rows) // 2 :][: len(rows) // 2]
        edit = Edit(
            clone=kept[:1],
            relocate=(moved, target),
            keep=keep,
            add=seeds(2, self.generator),
        )
        number = self.random.randint(0, 1000)
        for model in self.both:
            model.edit(edit, torch.Generator().manual_seed(number), 2)

    def keep(self):
        take_missed_steps(self.parts, self.config)
        rows = torch.rand(len(self.whole), generator=self.generator) > 0.2
        rows[0] = True
        for model in self.both:
            model.keep(rows)

    def undo(self):
        undo = [model.undo_log.begin() for model in self.both]
        for model in self.both:
            model.undo_log.will_change()
        for _ in range(2):
            self.random.choice([self.append, self.step, self.restart, self.keep])()
        for take_back, model in zip(undo, self.both, strict=True):
            take_back()
            model.undo_log.end()

    def resume(self):
        self.whole, self.parts = (
            GaussianModel.from_state_dict(copy.deepcopy(m.state_dict())) for m in self.both
        )

    def catch_up(self):
        take_missed_steps(self.parts, self.config)

    def catch_up_part(self, part):
        take_missed_steps(part, self.config)


OPERATIONS = (
    "append",
    "step",
    "step",
    "step",
    "step_all",
    "restart",
    "edit",
    "keep",
    "undo",
    "resume",
    "catch_up",
)


@pytest.mark.parametrize("adam_steps", ["none", "shared", "per_row"])
@pytest.mark.parametrize("seed", range(4))
def test_parts_with_their_missed_steps_are_the_whole_map_in_any_order(adam_steps, seed):
    twins = Twins(adam_steps, seed)
    for _ in range(25):
        getattr(twins, twins.random.choice(OPERATIONS))()
        for model in twins.both:
            model.clock.check()
        assert torch.equal(twins.parts.clock.birth, twins.whole.clock.birth)
        assert twins.parts.clock.count == twins.whole.clock.count
    before = twins.parts.state_dict()
    now = params_now(twins.parts, twins.catch_up_part)
    some = torch.arange(0, len(twins.parts), 2)
    for name in PARAMETERS:
        torch.testing.assert_close(
            getattr(now, name),
            getattr(twins.whole.params, name),
            **CLOSE,
        )
        part = getattr(params_now(twins.parts, twins.catch_up_part, some), name)
        torch.testing.assert_close(
            part,
            getattr(now, name)[some],
            atol=1e-6,
            rtol=1e-5,
        )
        assert torch.equal(before["rows"][name], getattr(twins.parts.params, name))
    take_missed_steps(twins.parts, twins.config)
    assert int(twins.parts.clock.steps_missed.sum()) == 0
    for of in ("", "exp_avg.", "exp_avg_sq."):
        for name in PARAMETERS:
            pair = [model.columns[of + name] for model in (twins.parts, twins.whole)]
            assert pair[0].isfinite().all()
            torch.testing.assert_close(*pair, **CLOSE)
    again = params_now(twins.parts, twins.catch_up_part)
    assert again.xyz_W.data_ptr() == twins.parts.params.xyz_W.data_ptr()


@pytest.mark.parametrize("seed", range(3))
def test_rows_of_discs_in_any_order(seed, generator):
    """RTG-SLAM's optimiser on all rows, and on parts of them, while rows are added and removed and
    the run is resumed."""
    chance = random.Random(seed)
    n = 8
    model = SurfelModel(1)
    model.append(seeds(n, generator))
    whole, parts = (optimiser_of(copy.deepcopy(model)) for _ in range(2))
    for _ in range(30):
        action = chance.choice(("step", "step", "step", "catch_up", "take_over", "resume"))
        n = whole.n
        seen = torch.tensor(sorted(chance.sample(range(n), chance.randint(1, n))))
        if action == "step":
            g = gradients(whole.params, seen, generator)
            adam_step(whole.copies, g, whole.adam)
            part = MapPart(parts.copies, seen)
            take_missed_steps(part, parts.adam)
            adam_step(part, g[seen], parts.adam)
            part.write_back()
        elif action == "catch_up":
            part = MapPart(parts.copies, seen)
            take_missed_steps(part, parts.adam)
            part.write_back()
        elif action == "take_over":
            parts.take_missed_steps()
            before = torch.cat([seen, torch.tensor([-1])])
            whole, parts = (taken_over(optimiser, before) for optimiser in (whole, parts))
        else:
            whole, parts = (resumed(optimiser) for optimiser in (whole, parts))
        parts.copies.clock.check()
        whole.copies.clock.check()
    now = copy.deepcopy(parts.params_now())
    parts.take_missed_steps()
    for name in PARAMETERS:
        torch.testing.assert_close(
            getattr(parts.params, name), getattr(whole.params, name), **CLOSE
        )
        assert torch.equal(getattr(now, name), getattr(parts.params, name))


def optimiser_of(model: SurfelModel) -> SurfelOptimiser:
    """Of all rows."""
    rates = {"lr_xyz": 1e-3, "lr_log_scale": 1e-2, "lr_sh_dc": 1e-2}
    window = dataclasses.replace(WindowConfig(), **rates)
    return SurfelOptimiser(model, torch.ones(len(model), dtype=torch.bool), window, DiscConfig())


def taken_over(optimiser: SurfelOptimiser, before: torch.Tensor) -> SurfelOptimiser:
    """The optimiser after the rows ``before`` of it, -1 for a new one."""
    optimiser.write_back()
    model = copy.deepcopy(optimiser._model)
    n = len(model)
    model.columns.copy_rows(before.clamp_min(0))
    model.keep(torch.arange(len(model)) >= n)
    again = optimiser_of(model)
    again.take_over(optimiser, before)
    return again


def resumed(optimiser: SurfelOptimiser) -> SurfelOptimiser:
    """The optimiser from its state, which stays as it was when the optimiser goes on."""
    optimiser.write_back()
    state = optimiser.state_dict()
    again = optimiser_of(copy.deepcopy(optimiser._model))
    adam_step(optimiser.copies, optimiser.copies.params, optimiser.adam)
    again.load_state_dict(state)
    return again


def test_a_row_that_was_restarted_out_of_view_moves_by_finite_steps(generator):
    """Not seen for longer than since the restart: its age before the missed steps would be below
    zero."""
    model = GaussianModel(0)
    config = OptimConfig(adam_steps="per_row")
    model.append(seeds(2, generator))
    first = torch.tensor([0])
    second = torch.tensor([1])
    for rows, steps in ((first, 3), (second, 5)):
        for _ in range(steps):
            part = MapPart(model, rows)
            adam_step(part, gradients(model.params, rows, generator)[rows], config)
            part.write_back()
    restart_optimiser(model)
    before = model.params.xyz_W.clone()
    take_missed_steps(model, config)
    assert torch.equal(model.params.xyz_W, before)
    assert model.clock.age_at_last.tolist() == [0, 0]


def test_checkpoints_with_rows_that_began_after_their_last_step_load(generator):
    """As versions wrote them that set only ``birth_step`` when moments were forgotten."""
    model = GaussianModel(0)
    config = OptimConfig(adam_steps="per_row")
    model.append(seeds(3, generator))
    model.clock.advance(40)
    state = copy.deepcopy(model.state_dict())
    state["rows"]["birth_step"][:] = torch.tensor([40, 40, 0])
    state["rows"]["last_step"][:] = torch.tensor([12, 40, 33])
    again = GaussianModel.from_state_dict(state)
    again.clock.check()
    assert (again.clock.birth.tolist(), again.clock.last.tolist()) == ([40, 40, 0], [40, 40, 33])
    take_missed_steps(again, config)
    assert again.params.xyz_W.isfinite().all()


def test_a_clock_does_not_go_back_and_an_old_part_is_refused(generator):
    model = GaussianModel(0)
    model.append(seeds(3, generator))
    old = model.clock.part(torch.tensor([0]))
    model.clock.step()
    assert model.clock.count == 1
    with pytest.raises(ValueError, match="does not go back, from 1 to 0"):
        model.clock.advance(0)
    with pytest.raises(ValueError, match="a part with 0 steps is older than its map, which has 1"):
        model.clock.write_back(torch.tensor([0]), old)
    clock = StepClock.of_new_rows(2, torch.device("cpu"))
    clock.birth[1] = 1
    with pytest.raises(ValueError, match=r"0 <= birth <= last <= count, got 1, 0 and 0 in row 1"):
        clock.check()


def test_discs_keep_the_invariant_when_frames_are_counted(generator):
    model = SurfelModel(sh_degree=0)
    model.append(seeds(4, generator))
    model.clock.advance(5)
    model.edit(
        Edit(set={"state": (torch.tensor([1]), torch.tensor([0]))}),
        generator,
    )
    model.clock.check()
    assert model.clock.birth.tolist() == [0, 5, 0, 0]
    assert int(model.clock.steps_missed.sum()) == 0
