"""check_rule passes sound rules and names what is wrong with the others."""

import inspect
import random
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from gsfusion_nb.gaussians import Edit, GaussianModel
from gsfusion_nb.seeding import MapRule, SeedContext, Seeds, check_rule, registered

SEED_WHAT_IS_MAPPED = (
    "gs_icp",
    "gs_slam",
    "hf_slam",
    "monogs",
    "monogs_like",
    "photo_slam",
    "vg_mapping",
    "vings",
)
"""Rules that look for errors where the map is, or do not look at it at all."""


@pytest.mark.parametrize("name", sorted(registered()))
def test_every_registered_rule_keeps_the_contract(name):
    report = check_rule(name)
    assert report.rule == name
    assert report.seeds["new"] > 0
    assert report.seeds["half seen"] > 0
    assert name in SEED_WHAT_IS_MAPPED or report.seeds["new"] > report.seeds["half seen"]
    assert report.seeds["dark"] == 0
    assert "keeps the contract" in repr(report)


def brightens_frame(ctx):
    ctx.frame.rgb.mul_(0.5)
    return ctx.cells()


def moves_map(ctx):
    ctx.map.xyz_W.add_(0.1)
    return ctx.cells()


def moves_real_map_as_array(ctx):
    if isinstance(ctx.gaussians, GaussianModel):
        ctx.gaussians.params.xyz_W.numpy()[:] += 0.1  # torch does not count such writes
    return ctx.cells()


CALLS = []


def every_tenth(ctx):
    CALLS.append(ctx.frame.index)
    return ctx.cells()[len(CALLS) % 1000 == 0 :]


def global_torch(ctx):
    cells = ctx.cells()
    return cells[torch.rand(len(cells)) < 0.5]


def global_numpy(ctx):
    cells = ctx.cells()
    return cells[torch.from_numpy(np.random.rand(len(cells)) < 0.5)]  # noqa: NPY002


def global_python(ctx):
    return ctx.cells()[random.randrange(100) :]


def seeds_torch(ctx):
    torch.manual_seed(0)
    return ctx.cells()


class Remembers:
    """A rule that gives one seed less at each call."""

    __name__ = "remembers"

    def __init__(self):
        self.calls = 0

    def __call__(self, ctx):
        self.calls += 1
        return ctx.cells()[self.calls :]


def camera_frame(ctx):
    seeds = ctx.cells()
    xyz_C = (seeds.xyz_W - ctx.frame.T_WC[:3, 3]) @ ctx.frame.T_WC[:3, :3]
    object.__setattr__(seeds, "xyz_W", xyz_C)
    return seeds


def ignores_holes(ctx):
    n = 5
    ahead = ctx.frame.T_WC[:3, 3] + ctx.frame.T_WC[:3, 2]
    return Seeds.isotropic(
        ahead.expand(n, 3),
        torch.full((n, 3), 0.5),
        torch.full((n,), 0.01),
    )


@pytest.mark.parametrize(
    ("rule", "sentence"),
    [
        (
            brightens_frame,
            r"'brightens_frame', scene 'new': it changed frame\.rgb in place; work on a copy",
        ),
        (moves_map, r"'moves_map', scene '[\w ]+': it changed map\.xyz_W in place"),
        (moves_real_map_as_array, r"scene 'half seen': it changed map\.xyz_W in place"),
        (every_tenth, "scene 'new': it keeps something from one frame to the next"),
        (global_torch, "drew random numbers from torch's global generator"),
        (seeds_torch, "drew random numbers from torch's global generator"),
        (global_numpy, "two runs on the same input gave different seeds"),
        (global_python, "two runs on the same input gave different seeds"),
        (Remembers(), "two runs on the same input gave different seeds"),
        (camera_frame, "seeds lie behind the camera; xyz_W is in the world frame"),
        (ignores_holes, "the frame has no depth, yet it gave 5 seeds"),
    ],
)
def test_broken_rules_are_named(rule, sentence):
    state = torch.get_rng_state()
    with pytest.raises(AssertionError, match=sentence):
        check_rule(rule)
    torch.set_rng_state(state)


@dataclass(frozen=True, kw_only=True)
class NewVoxels(MapRule):
    """Cells in coarse voxels that it did not seed before, which it keeps in its memory."""

    size_m: float = 0.1

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """New voxels only."""
        cells = ctx.cells()
        key = (cells.xyz_W / self.size_m).floor().long() @ torch.tensor([1, 1000, 1000000])
        known = memory.get("known", key[:0])
        fresh = ~torch.isin(key, known)
        memory["known"] = torch.cat([known, key[fresh]])
        return cells[fresh]


def test_a_class_rule_with_a_memory_keeps_the_contract():
    report = check_rule(NewVoxels)
    assert report.seeds["walk"] > 0
    assert "except in ctx.memory" in repr(report)


@dataclass(frozen=True, kw_only=True)
class HidesState(MapRule):
    """Counts in an attribute of its class."""

    calls: ClassVar[list[int]] = []

    def seeds(self, ctx, memory):
        self.calls.append(1)
        return ctx.cells()


@dataclass(frozen=True, kw_only=True)
class TellsTheTime(MapRule):
    """Its memory differs from run to run."""

    def seeds(self, ctx, memory):
        memory["at"] = memory.get("at", 0) + random.random()
        return ctx.cells()


@dataclass(frozen=True, kw_only=True)
class MovesOldGaussians(MapRule):
    """Changes the map, but only if it has seen it before."""

    def seeds(self, ctx, memory):
        if memory.setdefault("frames", 0) > 1:
            ctx.gaussians.params.opacity_logit[0] = 0.0
        memory["frames"] += 1
        return ctx.cells()


@dataclass(frozen=True, kw_only=True)
class KeepsTheFrame(MapRule):
    """Keeps what a checkpoint cannot save."""

    def seeds(self, ctx, memory):
        memory["frame"] = ctx.frame
        return ctx.cells()


@pytest.mark.parametrize(
    ("rule", "error", "sentence"),
    [
        (
            HidesState,
            AssertionError,
            r"it keeps something from one frame to the next .*: keep it in ctx\.memory",
        ),
        (
            TellsTheTime,
            AssertionError,
            "two runs on the same input left different values in its memory",
        ),
        (
            MovesOldGaussians,
            AssertionError,
            r"scene 'walk', frame 2: it changed map\.opacity_logit in place",
        ),
        (KeepsTheFrame, TypeError, r"'KeepsTheFrame' keeps a Frame in its memory\['frame'\]"),
    ],
)
def test_broken_class_rules_are_named(rule, error, sentence):
    with pytest.raises(error, match=sentence):
        check_rule(rule)


@dataclass(frozen=True, kw_only=True)
class AfterSteps(MapRule):
    """Seeds the cells, and does after steps what a test says."""

    needs: ClassVar[frozenset[str]] = frozenset()

    def seeds(self, ctx, memory):
        return ctx.cells()


@dataclass(frozen=True, kw_only=True)
class KeepsTheFrameAfterSteps(AfterSteps):
    """Keeps what a checkpoint cannot save, but only after a step."""

    def after_step(self, ctx, stats, memory):
        memory["frame"] = ctx.frame
        return


@dataclass(frozen=True, kw_only=True)
class ReturnsAMask(AfterSteps):
    """Returns a mask in place of an edit."""

    def after_step(self, ctx, stats, memory):
        return ctx.map.opacity > 0.5


@dataclass(frozen=True, kw_only=True)
class RemovesAtRandom(AfterSteps):
    """Draws from a generator that nobody gave it."""

    def after_step(self, ctx, stats, memory):
        return Edit(keep=torch.rand(len(ctx.map)) < 0.5)


@dataclass(frozen=True, kw_only=True)
class RemovesTooMany(AfterSteps):
    """Its mask is too short."""

    def after_step(self, ctx, stats, memory):
        return Edit(keep=torch.ones(1, dtype=torch.bool))


@pytest.mark.parametrize(
    ("rule", "error", "sentence"),
    [
        (
            KeepsTheFrameAfterSteps,
            TypeError,
            r"'KeepsTheFrameAfterSteps' keeps a Frame in its memory\['frame'\]",
        ),
        (ReturnsAMask, TypeError, "after_step must return an Edit or None, got"),
        (RemovesAtRandom, AssertionError, "global generator|gave different edits"),
        (RemovesTooMany, (AssertionError, ValueError), "keep"),
    ],
)
def test_broken_edits_are_named(rule, error, sentence):
    with pytest.raises(error, match=sentence):
        check_rule(inspect.unwrap(rule))
