"""Settings that a rule brings: they apply once, are stored, and the user's own settings can stay."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest

from gsfusion_nb.config import GSFusionConfig, from_dict, gsfusion, replace, rtg_slam, to_dict
from gsfusion_nb.mapping import RTGSLAM, GSFusion
from gsfusion_nb.mapping.rule import settings_with_rule
from gsfusion_nb.seeding import KEYFRAMES, MapRule, SeedContext, Seeds, When


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


@pytest.mark.parametrize(
    ("own", "rate", "iterations"),
    [
        ((), 1e-3, 7),
        (("optim.lr_xyz",), 1.6e-4, 7),
        (("optim__lr_xyz",), 1.6e-4, 7),
        (("optim.lr-xyz", "keyframe_every"), 1.6e-4, 7),
        (("optim",), 1.6e-4, 3),
        (("all",), 1.6e-4, 3),
        (("tsdf",), 1e-3, 7),
    ],
)
def test_settings_that_the_user_names_stay(own, rate, iterations):
    settings = gsfusion("room", seeding__own_settings=own)
    used = settings_with_rule(settings, bringing(optim__lr_xyz=1e-3, optim__frame_iterations=7))
    assert (used.optim.lr_xyz, used.optim.frame_iterations) == (rate, iterations)
    assert from_dict(GSFusionConfig, to_dict(used)) == used


def test_what_the_user_and_a_data_set_set_counts_more_than_the_rule_and_a_fidelity_less():
    rule = bringing(optim__lr_xyz=1e-3, optim__frame_iterations=7, keyframe_every=5)
    used = settings_with_rule(gsfusion("room", keyframe_every=3, optim__lr_xyz=1.6e-4), rule)
    assert (used.keyframe_every, used.optim.lr_xyz, used.optim.frame_iterations) == (3, 1.6e-4, 7)
    assert settings_with_rule(gsfusion("tum"), rule).optim.frame_iterations == 5  # published for TUM
    rule = bringing(window__lr_sh_dc=1e-4, keyframe_every=5)
    for fidelity in ("measured", "paper", "code"):
        assert RTGSLAM(rtg_slam("room", fidelity), seeding=rule).config.window.lr_sh_dc == 1e-4
    assert RTGSLAM(rtg_slam("room", window__lr_sh_dc=2e-3), seeding=rule).config.window.lr_sh_dc == 2e-3


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


def test_own_settings_must_exist():
    with pytest.raises(ValueError, match=r"optim\.speed"):
        GSFusion(gsfusion("room", seeding__own_settings=("optim.speed",)), seeding=bringing(optim__lr_xyz=1e-3))


def test_a_rule_for_keyframes_may_bring_them(config):
    rule = bringing(keyframe_every=2)
    rule.when = KEYFRAMES
    assert GSFusion(config, seeding=rule).config.keyframe_every == 2
    with pytest.raises(ValueError, match="set keyframe_every"):
        GSFusion(replace(config, seeding__own_settings=("keyframe_every",)), seeding=rule)
    assert isinstance(rule.when, When)


def test_a_run_continues_with_its_own_settings(split, config):
    made = GSFusion(config, seeding=bringing(optim__lr_xyz=1e-3))
    made.step(split.mapping[0])
    state = made.state_dict()
    same = GSFusion.from_state_dict(state, seeding=bringing(optim__lr_xyz=1e-3))
    assert same.config == made.config
    edited = GSFusion.from_state_dict(state, seeding=bringing(optim__lr_xyz=5e-3, optim__lr_quat=1e-2))
    assert edited.config.optim == made.config.optim
    assert "optim.lr_quat" in edited.config.seeding.own_settings
    assert len(edited.notes) == 1


@pytest.mark.parametrize(("stride", "used"), [(1, 5), (2, 2), (6, 1)])
def test_a_rules_own_interval_of_keyframes_counts_frames_of_the_recording(stride, used):
    rule = bringing(keyframe_every=5)
    found = settings_with_rule(gsfusion("room", data__stride=stride), rule)
    assert found.keyframe_every == used
    assert settings_with_rule(found, rule) == found
    given = settings_with_rule(gsfusion("room", data__stride=stride, keyframe_every=3), rule)
    assert given.keyframe_every == 3  # the user's own counts mapped frames
