"""The rule of a mapper: its options, its state, when it is asked, and the settings that it
brings."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import torch

from gsfusion_nb.config import GSFusionConfig, RtgSlamConfig, gsfusion, replace, rtg_slam
from gsfusion_nb.mapping import RTGSLAM, GSFusion, HalfMappedError, make_mapper
from gsfusion_nb.mapping.rule_settings import settings_with_rule
from gsfusion_nb.seeding import (
    MapRule,
    SeedContext,
    Seeds,
    When,
    every,
    get_rule,
    submaps,
)
from gsfusion_nb.seeding.input_guard import ChangedInputError


@pytest.fixture
def frames(split):
    return [split.mapping[i] for i in range(3)]


def every_nth(ctx: SeedContext, *, nth: int = 3) -> Seeds:
    """Every n-th cell."""
    return ctx.cells()[::nth]


def test_the_settings_hold_the_rule_and_the_options_in_use(config):
    mapper = GSFusion(replace(config, seeding__options={"fraction": 0.1}), seeding="uniform")
    assert (mapper.config.seeding.rule, mapper.config.seeding.options) == (
        "uniform",
        {"fraction": 0.1},
    )
    own = rtg_slam("room")
    assert own.seeding.options  # for its own rule
    assert RTGSLAM(own, seeding=every_nth).config.seeding.options == {}
    given = replace(own, seeding__options={"nth": 5})
    assert RTGSLAM(given, seeding=every_nth).config.seeding.options == {"nth": 5}
    neither = replace(own, seeding__options={"speed": 5})
    # refused by the first frame
    assert settings_with_rule(neither, every_nth).seeding.options == {"speed": 5}
    assert settings_with_rule(own, get_rule("rtg_slam")) == own


def test_a_rule_that_changes_the_map_ends_it(config, frames):
    def shrinks(ctx: SeedContext) -> Seeds:
        if len(ctx.map):
            ctx.gaussians.params.log_scale.sub_(1.0)
        return ctx.cells()

    mapper = GSFusion(config, seeding=shrinks)
    mapper.step(frames[0])
    with pytest.raises(ChangedInputError, match=r"'shrinks' changed map\.log_scale in place"):
        mapper.step(frames[1])
    with pytest.raises(HalfMappedError, match="the map was changed by its seeding rule 'shrinks'"):
        mapper.step(frames[1])


def test_a_rule_that_changes_the_frame_leaves_it_as_it_was(config, frames):
    def blinds(ctx: SeedContext) -> Seeds:
        ctx.frame.depth_m[ctx.frame.depth_m > 2] = 0
        return ctx.cells()

    mapper = GSFusion(config, seeding=blinds)
    depth_m = frames[0].depth_m.clone()
    with pytest.raises(ChangedInputError, match=r"frame\.depth_m"):
        mapper.step(frames[0])
    assert torch.equal(frames[0].depth_m, depth_m)


def test_what_a_rule_has_cached_ends_with_its_mapper(config, frames):
    """A file that it read may have changed since."""
    reads = []

    @functools.cache
    def nth() -> int:
        reads.append(3)
        return 3

    def cached(ctx: SeedContext) -> Seeds:
        return ctx.cells()[:: nth()]

    for n_mappers in (1, 2):
        mapper = GSFusion(config, seeding=cached)
        for frame in frames[:2]:
            mapper.step(frame)
        assert len(reads) == n_mappers


def test_a_rule_that_keeps_something_cannot_be_resumed(config, frames):
    seen = []

    def fewer_each_time(ctx: SeedContext) -> Seeds:
        seen.append(ctx.frame.index)
        return ctx.cells()[len(seen) :]

    mapper = GSFusion(config, seeding=fewer_each_time)
    fresh = mapper.state_dict()
    mapper.step(frames[0])
    assert fresh["rule"]["fingerprint"] == mapper.state_dict()["rule"]["fingerprint"]
    with pytest.raises(
        ValueError, match="'fewer_each_time' stores something from one frame to the next"
    ):
        GSFusion.from_state_dict(mapper.state_dict(), seeding=fewer_each_time)


@pytest.fixture
def walk(split):
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
@pytest.mark.parametrize(
    ("when", "asked"),
    [(every(2), [0, 2]), (submaps(3), [0, 3])],
)
def test_a_rule_is_asked_only_when_it_is_due(system, when, asked, walk, config):
    settings = config if system is GSFusion else small_rtg_slam()
    mapper = make_mapper(settings, seeding=rule_due(when))
    new = [mapper.step(frame).n_seeds for frame in walk]
    assert [i for i, n in enumerate(new) if n] == asked
    assert mapper.rule_in_use.memory["asked"] == [walk[i].index for i in asked]
    assert mapper.rule_in_use.memory["starts"] == [i == 0 or when == submaps(3) for i in asked]


def test_draws_of_a_rule_shift_neither_keyframes_nor_passes(walk, config):
    drawn = []
    for draws in (1, 5):
        settings = replace(config, keyframe_every=1, seeding__options={"draws": draws})
        mapper = GSFusion(settings, seeding=random_cells)
        for frame in walk:
            mapper.step(frame)
        next(iter(mapper.global_optimise(1)))
        views = [k.index for k in mapper.keyframes.draw(2, mapper.random.keyframes)]
        drawn.append((mapper.passes.queue, views, mapper.random.rule.get_state().tolist()))
    assert drawn[0][:2] == drawn[1][:2]
    assert drawn[0][2] != drawn[1][2]


@pytest.mark.parametrize("system", [GSFusion, RTGSLAM])
def test_a_resumed_map_with_a_memory_is_equal_bit_for_bit(system, walk, config):
    settings = config if system is GSFusion else small_rtg_slam()
    whole, half = (make_mapper(settings, seeding=Remembering) for _ in range(2))
    for frame in walk:
        whole.step(frame)
    for frame in walk[:2]:
        half.step(frame)
    state = half.state_dict()
    kept = state["rule"]["memory"]["voxels"].clone()
    half.step(walk[2])  # the checkpoint shares nothing with the mapper
    assert torch.equal(state["rule"]["memory"]["voxels"], kept)
    resumed = system.from_state_dict(state, seeding=Remembering)
    assert not resumed.notes
    for frame in walk[2:]:
        resumed.step(frame)
    for name, column in vars(whole.gaussians.params).items():
        assert torch.equal(column, getattr(resumed.gaussians.params, name)), name
    assert resumed.rule_in_use.memory["calls"] == 4
    assert torch.equal(resumed.rule_in_use.memory["voxels"], whole.rule_in_use.memory["voxels"])


def test_a_frame_that_fails_leaves_the_memory_as_it_was(walk, config):
    mapper = GSFusion(replace(config, seeding__options={"fail_at": 2}), seeding=Remembering)
    mapper.step(walk[0])
    voxels = mapper.rule_in_use.memory["voxels"].clone()
    memory = mapper.rule_in_use.memory
    with pytest.raises(RuntimeError, match="my rule is broken"):
        mapper.step(walk[1])
    assert mapper.rule_in_use.memory is memory
    assert memory["calls"] == 1
    assert torch.equal(memory["voxels"], voxels)


def bringing(**overrides: Any) -> type[MapRule]:
    @dataclass(frozen=True, kw_only=True)
    class brings(MapRule):
        """All cells."""

        overrides: ClassVar[Mapping[str, Any]] = {}

        def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
            return ctx.cells()

    brings.overrides = overrides
    return brings


def test_a_rule_brings_settings_and_they_apply_once(config):
    rule = bringing(optim__lr_xyz=1e-3, keyframe_every=4, optim__depth_weight=1.0)
    mapper = GSFusion(config, seeding=rule)
    used = mapper.config
    assert (used.optim.lr_xyz, used.keyframe_every, used.optim.depth_weight) == (1e-3, 4, 1.0)
    brought = {"optim__lr_xyz": 1e-3, "keyframe_every": 4, "optim__depth_weight": 1.0}
    assert used == replace(config, seeding__rule="brings", **brought)
    assert settings_with_rule(used, rule) == used


def test_what_the_user_and_a_data_set_set_counts_more_than_the_rule_and_a_fidelity_less():
    rule = bringing(optim__lr_xyz=1e-3, optim__frame_iterations=7, keyframe_every=5)
    used = settings_with_rule(gsfusion("room", keyframe_every=3, optim__lr_xyz=1.6e-4), rule)
    assert (used.keyframe_every, used.optim.lr_xyz, used.optim.frame_iterations) == (3, 1.6e-4, 7)
    assert settings_with_rule(gsfusion("tum"), rule).optim.frame_iterations == 7
    # published for TUM
    assert settings_with_rule(gsfusion("tum", "code"), rule).optim.frame_iterations == 5
    rule = bringing(window__lr_sh_dc=1e-4, keyframe_every=5)
    for fidelity in ("measured", "paper", "code"):
        assert RTGSLAM(rtg_slam("room", fidelity), seeding=rule).config.window.lr_sh_dc == 1e-4
    assert (
        RTGSLAM(rtg_slam("room", window__lr_sh_dc=2e-3), seeding=rule).config.window.lr_sh_dc
        == 2e-3
    )


@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        ({"optim__lr_xzy": 1.0}, r"optim\.lr_xzy"),
        ({"window__frames": 1}, r"window\.frames"),
        ({"optim__lr_xyz__x": 1}, r"optim\.lr_xyz\.x"),
        ({"data__width": 64}, r"data\.width"),
        ({"seeding__options": {}}, r"seeding\.options"),
        ({"optim__lr_xyz": -1.0}, r"optim\.lr_xyz"),
        ({"seeding__own_settings": ("optim.speed",)}, r"seeding\.own_settings"),
    ],
)
def test_a_setting_that_cannot_be_brought_is_named(overrides, name):
    with pytest.raises(ValueError, match=name):
        GSFusion(GSFusionConfig(), seeding=bringing(**overrides))


@pytest.mark.parametrize(
    ("stride", "used"),
    [(1, 5), (2, 2), (6, 1)],
)
def test_a_rules_own_interval_of_keyframes_counts_frames_of_the_recording(stride, used):
    rule = bringing(keyframe_every=5)
    found = settings_with_rule(gsfusion("room", data__stride=stride), rule)
    assert found.keyframe_every == used
    assert settings_with_rule(found, rule) == found
    given = settings_with_rule(gsfusion("room", data__stride=stride, keyframe_every=3), rule)
    assert given.keyframe_every == 3  # the user's own counts mapped frames
