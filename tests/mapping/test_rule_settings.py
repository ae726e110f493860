"""Settings that a rule brings: they apply once, are stored, and the user's own settings can stay."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest

from gsfusion_nb.config import GSFusionConfig, from_dict, gsfusion, replace, rtg_slam, to_dict
from gsfusion_nb.mapping import RTGSLAM, GSFusion
from gsfusion_nb.mapping.rule import settings_with_rule
from gsfusion_nb.seeding import KEYFRAMES, MapRule, SeedContext, Seeds, When, get_rule


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
    assert settings_with_rule(used, rule) is used
    assert settings_with_rule(config, get_rule("gsfusion")) is config


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


def test_values_that_are_not_usual_are_the_users_own():
    rule = bringing(optim__lr_xyz=1e-3, optim__frame_iterations=7, keyframe_every=5)
    used = settings_with_rule(gsfusion("room", keyframe_every=3, optim__lr_xyz=2e-4), rule)
    assert (used.keyframe_every, used.optim.lr_xyz, used.optim.frame_iterations) == (3, 2e-4, 7)
    assert settings_with_rule(gsfusion("tum"), rule).optim.frame_iterations == 5  # published for TUM


def test_values_of_the_usual_presets_are_not_the_users_own():
    rule = bringing(window__lr_sh_dc=1e-4, keyframe_every=5)
    for fidelity in ("measured", "paper", "code"):
        assert RTGSLAM(rtg_slam("room", fidelity), seeding=rule).config.window.lr_sh_dc == 1e-4
    own = rtg_slam("room", window__lr_sh_dc=2e-3)
    assert RTGSLAM(own, seeding=rule).config.window.lr_sh_dc == 2e-3


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        ({"optim__lr_xzy": 1.0}, r"'brings' brings the setting 'optim\.lr_xzy', which GSFusionConfig does not have; k"),
        ({"window__frames": 1}, r"'brings' brings the setting 'window\.frames', which GSFusionConfig does not have"),
        ({"optim": {}}, r"'optim', which is a group; expected a single setting, such as optim\.lr_xyz"),
        ({"optim__lr_xyz__x": 1}, r"'optim\.lr_xyz\.x', which GSFusionConfig does not have; known here: none"),
        ({"data__width": 64}, r"'data\.width', which only the user can set; a rule cannot bring data, seed"),
        ({"seeding__options": {}}, r"'seeding\.options', which only the user can set"),
        ({"optim__lr_xyz": -1.0}, r"'brings' brings settings that are refused: optim\.lr_xyz must be between 0 and 10"),
    ],
)  # fmt: skip
def test_a_setting_that_cannot_be_brought_is_refused_with_rule_and_name(overrides, sentence):
    with pytest.raises(ValueError, match=sentence):
        GSFusion(GSFusionConfig(), seeding=bringing(**overrides))


def test_own_settings_must_exist():
    with pytest.raises(ValueError, match=r"seeding\.own_settings names 'optim\.speed', which GSFusionConfig does not"):
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
    assert edited.config.seeding.own_settings == ("optim.lr_quat",)
    assert len(edited.notes) == 1


@pytest.mark.parametrize(("stride", "used"), [(1, 5), (2, 2), (6, 1)])
def test_a_rules_own_interval_of_keyframes_counts_frames_of_the_recording(stride, used):
    rule = bringing(keyframe_every=5)
    found = settings_with_rule(gsfusion("room", data__stride=stride), rule)
    assert found.keyframe_every == used
    assert settings_with_rule(found, rule) == found
    given = settings_with_rule(gsfusion("room", data__stride=stride, keyframe_every=3), rule)
    assert given.keyframe_every == 3  # the user's own counts mapped frames
