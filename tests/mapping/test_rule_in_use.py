"""The rule and options that ran are the ones that are stored; a checkpoint goes on with the same rule or says so."""

import pytest
import torch

from gsfusion_nb.config import replace, rtg_slam
from gsfusion_nb.mapping import RTGSLAM, GSFusion
from gsfusion_nb.mapping.rule import settings_with_rule
from gsfusion_nb.mapping.step import HalfMappedError
from gsfusion_nb.seeding import (
    ChangedInputError,
    SeedContext,
    Seeds,
    get_rule,
    seeding_rule,
)


@pytest.fixture
def frames(split):
    return [split.mapping[i] for i in range(3)]


def every(ctx: SeedContext, *, nth: int = 3) -> Seeds:
    """Every n-th cell."""
    return ctx.cells()[::nth]


def test_the_settings_hold_the_rule_and_the_options_in_use(config):
    mapper = GSFusion(replace(config, seeding__options={"fraction": 0.1}), seeding="uniform")
    assert (mapper.config.seeding.rule, mapper.config.seeding.options) == ("uniform", {"fraction": 0.1})
    own = rtg_slam("room")
    assert own.seeding.options  # for its own rule
    assert RTGSLAM(own, seeding=every).config.seeding.options == {}
    given = replace(own, seeding__options={"nth": 5})
    assert RTGSLAM(given, seeding=every).config.seeding.options == {"nth": 5}
    neither = replace(own, seeding__options={"speed": 5})
    assert settings_with_rule(neither, every).seeding.options == {"speed": 5}  # refused by the first frame
    assert settings_with_rule(own, get_rule("rtg_slam")) == own


def test_a_rule_that_keeps_something_cannot_be_resumed(config, frames):
    seen = []

    def fewer_each_time(ctx: SeedContext) -> Seeds:
        seen.append(ctx.frame.index)
        return ctx.cells()[len(seen) :]

    mapper = GSFusion(config, seeding=fewer_each_time)
    fresh = mapper.state_dict()
    mapper.step(frames[0])
    assert fresh["rule"]["fingerprint"] == mapper.state_dict()["rule"]["fingerprint"]
    with pytest.raises(ValueError, match="'fewer_each_time' stores something from one frame to the next"):
        GSFusion.from_state_dict(mapper.state_dict(), seeding=fewer_each_time)


class FewerEachTime:
    """A rule that keeps its state with the map."""

    __name__ = "fewer_each_time"

    def __init__(self):
        self.n = 0

    def __call__(self, ctx: SeedContext) -> Seeds:
        self.n += 1
        return ctx.cells()[100 * self.n :]

    def state_dict(self):
        return {"n": self.n}

    def load_state_dict(self, state):
        self.n = state["n"]


def test_a_rule_with_a_state_goes_on_from_it(config, frames):
    whole = GSFusion(config, seeding=FewerEachTime())
    for frame in frames:
        whole.step(frame)
    half = GSFusion(config, seeding=FewerEachTime())
    half.step(frames[0])
    resumed = GSFusion.from_state_dict(half.state_dict(), seeding=FewerEachTime())
    for frame in frames[1:]:
        resumed.step(frame)
    assert not resumed.notes
    assert torch.equal(resumed.gaussians.params.sh, whole.gaussians.params.sh)


def test_another_rule_of_the_same_name_is_noticed(config, frames):
    @seeding_rule
    def mine(ctx: SeedContext) -> Seeds:
        return ctx.cells()

    mapper = GSFusion(config, seeding="mine")
    mapper.step(frames[0])
    state = mapper.state_dict()
    assert not GSFusion.from_state_dict(state).notes

    def fewer(ctx: SeedContext) -> Seeds:
        return ctx.cells()[::2]

    fewer.__name__ = "mine"
    seeding_rule(fewer)
    with pytest.raises(ValueError, match="'mine' of this run is not the one that is registered here by that name"):
        GSFusion.from_state_dict(state)
    [note] = GSFusion.from_state_dict(state, seeding=fewer).notes
    assert "after 1 frames the run continued with another seeding rule, or an edited one" in note
    state["rule"]["name"] = "yours"
    with pytest.raises(ValueError, match=r"'yours' of this run is not known here; its source is in rule.py"):
        GSFusion.from_state_dict(state)


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
