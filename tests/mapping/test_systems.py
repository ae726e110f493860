"""Systems by name."""

import dataclasses

import pytest
import torch

from gsfusion_nb.config import GpsSlamConfig, GSFusionConfig, RtgSlamConfig
from gsfusion_nb.config.gsfusion import presets
from gsfusion_nb.data.room import room
from gsfusion_nb.errors import BadFrameError
from gsfusion_nb.mapping import (
    GPSSLAM,
    RTGSLAM,
    SYSTEMS,
    GSFusion,
    get_system,
    make_mapper,
    system_of,
)


@pytest.mark.parametrize(
    ("name", "config", "mapper"),
    [
        ("gsfusion", GSFusionConfig, GSFusion),
        ("rtg_slam", RtgSlamConfig, RTGSLAM),
        ("gps_slam", GpsSlamConfig, GPSSLAM),
    ],
)
def test_settings_mapper_and_name_belong_together(name, config, mapper):
    system = get_system(name)
    assert (system, system.config_type) == (mapper, config)
    settings = system.preset("room")
    made = make_mapper(settings)
    assert type(settings) is config
    assert type(made) is mapper
    assert made.config is settings
    assert system_of(settings) == system_of(made.config) == name


@pytest.mark.parametrize("system", SYSTEMS)
def test_one_default(system):
    mapper = SYSTEMS[system]
    assert (
        mapper.config_type()
        == mapper.preset()
        == mapper.preset("replica", mapper.description.fidelities[0])
    )
    assert (
        mapper.description.fidelity_of(mapper.config_type())
        == mapper.description.fidelities[0]
        == "measured"
    )
    assert make_mapper(mapper.config_type()).config == mapper().config


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("preset", presets())
def test_every_system_has_every_preset(system, preset):
    for fidelity in SYSTEMS[system].description.fidelities:
        config = SYSTEMS[system].preset(preset, fidelity)
        first = next(
            f
            for f in SYSTEMS[system].description.fidelities
            if SYSTEMS[system].preset(preset, f) == config
        )
        assert SYSTEMS[system].description.fidelity_of(config) == first


def placed(frame, index, right_m):
    """``frame`` as the one with another number, a tenth of a second a frame, from a pose to the
    right of its own."""
    T_WC = frame.T_WC.clone()
    T_WC[0, 3] += right_m
    return dataclasses.replace(frame, index=index, timestamp_s=0.1 * index, T_WC=T_WC)


def small(system, **changes):
    volume = {} if system == "rtg_slam" else {"tsdf__voxel_size_m": 0.05}
    return make_mapper(SYSTEMS[system].preset("room", **volume, **changes))


@pytest.fixture(scope="module")
def view():
    return room(n_frames=240, width=64, height=48)[0]


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_jump_that_no_camera_makes_is_not_mapped(system, view):
    mapper = small(system)
    mapper.step(placed(view, 0, 0.0))
    with pytest.raises(BadFrameError, match=r"frame 1 .* 1e\+03 m .* --tracking.pose-jumps map"):
        mapper.step(placed(view, 1, 1000.0))
    mapper.step(placed(view, 2, 0.01))
    assert mapper.trajectory.frame_indices == [0, 2]
    asked = small(system, tracking__pose_jumps="map")
    for index, right_m in enumerate((0.0, 1000.0)):
        frame = placed(view, index, right_m)
        report = asked.step(frame)
    assert any(
        "although its pose is 1e+03 m" in warning
        for warning in asked.reports.step_warnings(frame, report)
    )


def test_after_a_jump_the_frames_that_go_on_are_mapped_also_after_a_pause(view):
    mapper = small("gsfusion")
    mapper.step(placed(view, 0, 1000.0))  # the first pose is the wrong one
    with pytest.raises(BadFrameError):
        mapper.step(placed(view, 1, 0.0))
    mapper = GSFusion.from_state_dict(mapper.state_dict())
    for index in (2, 3):
        mapper.step(placed(view, index, 0.0))
    assert mapper.trajectory.frame_indices == [0, 2, 3]


def test_a_depth_that_no_camera_measures_is_told_once(view):
    mapper = small("gsfusion")
    far = dataclasses.replace(view, depth_m=torch.full_like(view.depth_m, 65.5))
    frames = [placed(frame, i, 0.0) for i, frame in enumerate((view, far, far))]
    told = [mapper.reports.step_warnings(frame, mapper.step(frame)) for frame in frames]
    assert [len(warnings) for warnings in told] == [0, 1, 0]
    assert "depth-max-m" in told[1][0]


@pytest.mark.parametrize("fidelity", ["measured", "paper", "code", "rrg"])
def test_gps_slam_says_what_a_fidelity_does_not_follow(fidelity):
    notes = make_mapper(SYSTEMS["gps_slam"].preset("room", fidelity)).notes
    assert any("docs/gps_slam.md" in note for note in notes) == (fidelity != "measured")
