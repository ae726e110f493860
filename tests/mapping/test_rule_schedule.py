"""When a mapper asks its rule, which frames are keyframes, the random streams, and the rule's memory."""

from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import torch

from gsfusion_nb.config import RtgSlamConfig, replace, rtg_slam
from gsfusion_nb.mapping import RTGSLAM, GSFusion, get_system, make_mapper
from gsfusion_nb.seeding import KEYFRAMES, MapRule, SeedContext, Seeds, When, every, submaps


@pytest.fixture
def frames(split):
    return [split.mapping[i] for i in range(4)]


def small_rtg_slam(**changes: Any) -> RtgSlamConfig:
    """Few steps."""
    few = {"window__iterations": 4, "keyframes__iterations": 3}
    return rtg_slam("room", data__width=0, data__height=0, **few, **changes)


def random_cells(ctx: SeedContext, *, draws: int = 1, share: float = 0.5) -> Seeds:
    """A random share of the cells, after some more random numbers."""
    cells = ctx.cells()
    for _ in range(draws):
        drawn = torch.rand(len(cells), generator=ctx.generator)
    return cells[drawn < share]


def rule_due(when: When) -> type[MapRule]:
    @dataclass(frozen=True, kw_only=True)
    class noting(MapRule):
        """Writes down when it was asked."""

        def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
            memory.setdefault("asked", []).append(ctx.frame.index)
            memory.setdefault("starts", []).append(ctx.starts_submap)
            return ctx.cells()[::3]

    noting.when = when
    return noting


@dataclass(frozen=True, kw_only=True)
class Remembering(MapRule):
    """Seeds where it did not seed before, by a tensor in its memory, at random."""

    when: ClassVar[When] = every(1)
    fail_at: int = -1

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """New voxels only."""
        cells = ctx.cells()
        voxel = (cells.xyz_W / 0.2).floor().long() @ torch.tensor([1, 1000, 1000000])
        known = memory.get("voxels", torch.zeros(0, dtype=torch.int64))
        fresh = ~torch.isin(voxel, known) & (torch.rand(len(cells), generator=ctx.generator) < 0.7)
        memory["voxels"] = torch.cat([known, voxel[fresh]])
        memory["voxels"] += 0
        memory["calls"] = memory.get("calls", 0) + 1
        if memory["calls"] == self.fail_at:
            raise RuntimeError("my rule is broken")
        return cells[fresh]


@pytest.mark.parametrize("system", [GSFusion, RTGSLAM])
@pytest.mark.parametrize(("when", "asked"), [(every(2), [0, 2]), (submaps(3), [0, 3])])
def test_a_rule_is_asked_only_when_it_is_due(system, when, asked, frames, config):
    settings = config if system is GSFusion else small_rtg_slam()
    mapper = make_mapper(settings, seeding=rule_due(when))
    new = [mapper.step(frame).n_seeds for frame in frames]
    assert [i for i, n in enumerate(new) if n] == asked
    assert mapper.memory["asked"] == [frames[i].index for i in asked]
    assert mapper.memory["starts"] == [i == 0 or when == submaps(3) for i in asked]


def test_rtg_slam_knows_its_keyframes_before_the_rule_runs(frames):
    settings = small_rtg_slam(keyframes__rotation_deg=1e-3)
    mapper = RTGSLAM(settings, seeding=rule_due(KEYFRAMES))
    reports = [mapper.step(frame) for frame in (frames[0], frames[0], frames[1])]
    assert [report.is_keyframe for report in reports] == [True, False, True]
    assert [report.n_seeds > 0 for report in reports] == [True, False, True]


def test_with_keyframe_every_all_rules_get_the_same_steps(frames, config):
    settings = replace(config, keyframe_every=2)
    counts = []
    for share in (0.9, 0.1):
        mapper = GSFusion(replace(settings, seeding__options={"share": share}), seeding=random_cells)
        reports = [mapper.step(frame) for frame in frames]
        assert mapper.gaussians.step_count == sum(report.n_steps for report in reports)
        counts.append([(report.is_keyframe, report.n_steps) for report in reports])
    assert counts[0] == counts[1]
    assert [keyframe for keyframe, _ in counts[0]] == [True, False, True, False]
    with pytest.raises(ValueError, match="keyframe_every must be between 0 and inf, got -1"):
        replace(config, keyframe_every=-1)


def test_draws_of_a_rule_shift_neither_keyframes_nor_passes(frames, config):
    drawn = []
    for draws in (1, 5):
        settings = replace(config, keyframe_every=1, seeding__options={"draws": draws})
        mapper = GSFusion(settings, seeding=random_cells)
        for frame in frames:
            mapper.step(frame)
        next(iter(mapper.global_optimise(1)))
        views = [k.index for k in mapper.keyframes.draw(2, mapper.random.keyframes)]
        drawn.append((mapper.passes.queue, views, mapper.random.rule.get_state().tolist()))
    assert drawn[0][:2] == drawn[1][:2]
    assert drawn[0][2] != drawn[1][2]


@pytest.mark.parametrize("system", [GSFusion, RTGSLAM])
def test_a_resumed_map_with_a_memory_is_equal_bit_for_bit(system, frames, config):
    settings = config if system is GSFusion else small_rtg_slam()
    whole, half = (make_mapper(settings, seeding=Remembering) for _ in range(2))
    for frame in frames:
        whole.step(frame)
    for frame in frames[:2]:
        half.step(frame)
    state = half.state_dict()
    kept = state["rule"]["memory"]["voxels"].clone()
    half.step(frames[2])  # the checkpoint shares nothing with the mapper
    assert torch.equal(state["rule"]["memory"]["voxels"], kept)
    resumed = system.from_state_dict(state, seeding=Remembering)
    assert not resumed.notes
    for frame in frames[2:]:
        resumed.step(frame)
    for name, column in vars(whole.gaussians.params).items():
        assert torch.equal(column, getattr(resumed.gaussians.params, name)), name
    assert resumed.memory["calls"] == 4
    n = len(resumed.memory["voxels"])
    assert f", memory: voxels {n:,} int64, calls 4)" in repr(resumed)
    assert next(p for p in resumed.parts() if p.name == "values kept by the rule").size_bytes == 8 * n
    assert torch.equal(resumed.memory["voxels"], whole.memory["voxels"])


def test_a_frame_that_fails_leaves_the_memory_as_it_was(frames, config):
    mapper = GSFusion(replace(config, seeding__options={"fail_at": 2}), seeding=Remembering)
    mapper.step(frames[0])
    memory, voxels = mapper.memory, mapper.memory["voxels"].clone()
    with pytest.raises(RuntimeError, match="my rule is broken"):
        mapper.step(frames[1])
    assert mapper.memory is memory
    assert memory["calls"] == 1
    assert torch.equal(memory["voxels"], voxels)


@pytest.mark.parametrize("stride", [{"data__stride": 4}, {"seeding__source_stride": 4}])
@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam", "gps_slam"])
def test_every_system_counts_frames_of_the_recording(system, stride, frames):
    config = get_system(system).preset("room", data__width=0, data__height=0, **stride)
    mapper = make_mapper(config, seeding=rule_due(every(8)))
    for frame in frames[:3]:
        mapper.step(frame)
    assert mapper.memory["asked"] == [frames[0].index, frames[2].index]
