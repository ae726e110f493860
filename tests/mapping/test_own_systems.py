"""Systems of a user's own: registered in a process or loaded from a file; what is no system is
refused with its reason."""

import dataclasses
import sys

import pytest
import torch
from toy_system import SOURCE, write_toy

from gsfusion_nb.config import GSFusionConfig, Presets, SystemConfig
from gsfusion_nb.data.room import room
from gsfusion_nb.errors import BadFrameError
from gsfusion_nb.mapping import (
    SYSTEMS,
    GSFusion,
    Mapper,
    SystemDescription,
    get_system,
    make_mapper,
    mapping_system,
    system_names,
    system_of,
    systems,
)
from gsfusion_nb.seeding import registered
from gsfusion_nb.tracking import TrackingLostError


@pytest.fixture(autouse=True)
def own_registries(monkeypatch):
    """What a test registers is gone after it."""
    from gsfusion_nb.seeding.rule import keep_registered

    monkeypatch.setattr(systems, "_REGISTERED", dict(systems._REGISTERED))
    monkeypatch.setattr(systems, "_NAMES", dict(systems._NAMES))
    with keep_registered():
        yield


def frame(index=0):
    return room(n_frames=60, width=48, height=36)[index]


def test_a_system_in_a_file_with_its_rule_and_its_module(tmp_path):
    text = write_toy(tmp_path)
    system = get_system(text)
    assert get_system(text) is system
    config = system.preset("tum", steps=4)
    assert (config.steps, system.preset("tum").steps, system.preset("room").data.width) == (
        4,
        3,
        320,
    )
    assert system_of(config) == "Toy"
    assert "toy_grid" in registered()
    assert "toy_helper" not in sys.modules
    mapper = make_mapper(system.preset("room", data__width=48, data__height=36))
    report = mapper.step(frame())
    assert type(mapper) is system
    assert report.n_seeds == len(mapper.gaussians) > 10


def test_an_edited_file_is_another_system(tmp_path):
    text = write_toy(tmp_path)
    first = get_system(text)
    write_toy(tmp_path, SOURCE.replace("steps: int = 2", "steps: int = 7"))
    assert get_system(text).preset("room").steps == 7
    assert first.preset("room").steps == 2
    assert type(make_mapper(first.preset("room"))) is first


PLAIN = SOURCE.partition("class Toy(")[0]


@pytest.mark.parametrize(
    ("edit", "name", "message"),
    [
        (("", ""), "Toi", r"toy\.py has no system 'Toi'; it defines: Toy"),
        (("", ""), "toy_grid", r"expected a class derived from gsfusion_nb\.mapping\.Mapper, got"),
        (("class Toy(", "x = 1 / 0\nclass Toy("), "Toy", r"line \d+: ZeroDivisionError: division"),
        (("    def map_frame", "    def map_one"), "Toy", "the system Toy lacks map_frame"),
        (("    description = ", "    about = "), "Toy", "needs a description, such as"),
        (("    config_type = ToyConfig\n", ""), "Toy", "needs config_type, a dataclass derived"),
        (
            ("@dataclass(frozen=True, kw_only=True)\n", ""),
            "Toy",
            r"ToyConfig, the settings of the system Toy, needs @dataclass\(frozen=True",
        ),
        (("tum={", 'room={"step": 1}, tum={'), "Toy", "no settings for the preset 'room': .*step"),
        (("Presets.of(ToyConfig", "Presets.of(OptimConfig"), "Toy", "preset 'replica'"),
        (("Toy of one file", "GSFusion"), "Toy", "itself has a system of the title 'GSFusion'"),
        (("class Toy(", "class gps_slam("), "gps_slam", "has a system of the name 'gps_slam'"),
        (("def toy_grid", "def uniform"), "Toy", "there is a seeding rule 'uniform' already"),
    ],
)
def test_what_is_no_system_is_refused_with_its_reason(tmp_path, edit, name, message):
    text = write_toy(tmp_path, SOURCE.replace(*edit) if edit[0] else SOURCE)
    with pytest.raises((ValueError, TypeError), match=message):
        get_system(text.replace(":Toy", f":{name}"))


def test_names_that_nothing_has(tmp_path):
    with pytest.raises(KeyError, match=r"no system 'toy'; known: gps_slam, gsfusion, rtg_slam, or"):
        get_system("toy")
    with pytest.raises(FileNotFoundError, match="expected the file of the mapping system Toy"):
        get_system(f"{tmp_path}/nowhere.py:Toy")
    with pytest.raises(ValueError, match=r"expected a mapping system in a file as FILE\.py:name"):
        get_system(f"{tmp_path}/nowhere.py")


@dataclasses.dataclass(frozen=True, kw_only=True)
class OwnConfig(GSFusionConfig):
    """Settings of a system that is GSFusion but for its name."""


class Own(GSFusion):
    """A system of a notebook."""

    description = SystemDescription(title="Own")
    config_type = OwnConfig
    preset = Presets.of(OwnConfig)


def test_a_class_of_this_process():
    assert "Own" not in system_names()
    with pytest.raises(TypeError, match="expected the settings of a system"):
        make_mapper(OwnConfig())
    assert mapping_system(Own) is Own
    assert [*SYSTEMS, "Own"] == system_names()
    assert (get_system("Own"), get_system(Own), system_of(OwnConfig())) == (Own, Own, "Own")
    assert type(make_mapper(OwnConfig())) is Own


def test_settings_belong_to_one_system():
    class Double(GSFusion):
        description = SystemDescription(title="Double")

    with pytest.raises(ValueError, match="are the settings of the system 'gsfusion'; give Double"):
        mapping_system(Double)


def tracked(config: SystemConfig):
    return dataclasses.replace(
        config, tracking=dataclasses.replace(config.tracking, poses="tracked")
    )


def test_tracking_of_its_own(tmp_path):
    system = get_system(write_toy(tmp_path))
    mapper = system(tracked(system.preset("room", steps=0)))
    for index in range(3):
        report = mapper.step(frame(index))
    assert report.tracking["status"] == "ok"
    off_m = [
        float(pose[0, 3] - frame(i).T_WC[0, 3]) for i, pose in enumerate(mapper.trajectory.poses)
    ]
    assert off_m == pytest.approx([0, 0.001, 0.001], abs=1e-6)
    again = system.from_state_dict(mapper.state_dict())
    assert again.step(frame(3)).tracking == mapper.step(frame(3)).tracking
    assert torch.equal(again.trajectory.poses[-1], mapper.trajectory.poses[-1])


def test_a_pose_of_its_own_tracking_is_checked(tmp_path, monkeypatch):
    system = get_system(write_toy(tmp_path))
    mapper: Mapper = system(tracked(system.preset("room", steps=0)))
    mapper.step(frame(0))
    far = frame(1).T_WC.clone()
    far[0, 3] += 3.0

    def lost(self, frame, T_predicted):
        raise TrackingLostError("no picture fits")

    for find, message in (
        (lambda self, frame, T: far, "would have moved 3.0"),
        (lost, "frame 1 cannot be tracked: no picture fits"),
        (lambda self, frame, T: 2 * T, "must be rigid"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(system, "find_pose", find)
            with pytest.raises((BadFrameError, ValueError), match=message):
                mapper.step(frame(1))
        assert mapper.n_frames == 1
    assert mapper.step(frame(2)).tracking["status"] == "recovered"
