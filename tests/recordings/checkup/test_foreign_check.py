"""Recordings that others made: what the check says about them is true."""

import pytest

from gsfusion_nb.config import DataConfig, RepairConfig
from gsfusion_nb.recordings.checkup import check_recording
from gsfusion_nb.recordings.convert import ConvertOptions, convert

RPY = "rgbd_dataset_freiburg1_rpy_excerpt"


@pytest.mark.ci
def test_fast_rotation_is_no_wrong_calibration(shared_sequence):
    report = check_recording(shared_sequence(RPY), pictures=False)
    assert set(report.data.repair.changes) <= {"pose_offset_s", "depth_offset_s"}
    # by optical flow depth is 24 ms late, and the pictures agree with the motion capture
    assert report.data.repair.pose_offset_s + report.data.repair.depth_offset_s == pytest.approx(
        -0.024, abs=0.005
    )
    assert abs(report.data.repair.pose_offset_s) < 0.01
    assert "Tried: " in report["pose time"].sentence
    assert "the lens has 517.3 and 516.5" in report["focal length"].sentence
    assert report["registration"].verdict in ("ok", "unknown")
    assert report["principal point"].verdict == "unknown"


@pytest.mark.ci
def test_late_depth_is_no_colour_of_another_frame_and_no_jump(shared_sequence):
    folder = shared_sequence("rgbd_dataset_freiburg1_xyz_excerpt")
    report = check_recording(folder, pictures=False)
    assert [f.name for f in report.trouble] == ["pose time"]
    assert set(report.data.repair.changes) == {"depth_offset_s"}
    assert -0.026 < report.data.repair.depth_offset_s < -0.01


@pytest.mark.slow
def test_a_second_check_of_late_depth_finds_little_more(shared_sequence):
    folder = shared_sequence("rgbd_dataset_freiburg1_xyz_excerpt")
    data = DataConfig(repair=RepairConfig(depth_offset_s=-0.0161))
    again = check_recording(folder, data=data, pictures=False)
    assert {f.name for f in again.trouble} <= {"pose time"}, str(again)
    assert again.data.repair.depth_offset_s == pytest.approx(-0.02, abs=0.006)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("start", "stop"),
    [(0, 31), (15, 46), (30, 61), (40, 61)],
)
def test_no_window_of_it_asks_for_another_camera(shared_sequence, start, stop):
    report = check_recording(
        shared_sequence(RPY), data=DataConfig(start=start, stop=stop), pictures=False
    )
    assert set(report.data.repair.changes) <= {"pose_offset_s", "depth_offset_s"}
    assert all(f.name == "pose time" for f in report.trouble)


@pytest.mark.ci
def test_a_recording_without_poses_and_times(shared_sequence, tmp_path):
    options = ConvertOptions(poses="none", intrinsics="615 615 320 240")
    convert(shared_sequence("realsense_desk_excerpt"), tmp_path / "desk", options=options)
    report = check_recording(tmp_path / "desk", poses=False, pictures=False)
    # a quarter of it is the office behind the desk, farther than what is mapped
    assert [f.name for f in report.trouble] == ["depth coverage"]
    assert "--tsdf.far-m" in report["depth coverage"].repair
    assert report["registration"].verdict == "ok"
    assert {f.name for f in report.unknown} >= {"time stamps", "depth scale", "poses"}
    assert not report.data.repair.changes
