"""Recordings that others made, as they were found: what a conversion says about them is true."""

import json

import numpy as np

from gsfusion_nb.data.recorded.images import read_depth
from gsfusion_nb.recordings.convert import ConvertOptions, convert


def test_a_realsense_in_millimetres_with_durations_for_times(shared_sequence, tmp_path):
    options = ConvertOptions(poses="none", intrinsics="615 615 320 240", every=3)
    source = shared_sequence("realsense_desk_excerpt")
    report = convert(source, tmp_path / "desk", options=options)
    assert (report.frames, report.depth_scale, report.has_poses) == (10, 1000, False)
    told = " ".join(report.notes)
    assert "are not times" in told
    assert "1000 units a metre" in told
    assert "fps" not in json.loads((tmp_path / "desk/intrinsics.json").read_text())
    for i in (0, 9):  # the order of the list, which is that of the files' numbers
        stored = read_depth(source / f"depths/depth{2 + 3 * i:05d}.png", scale=1000.0)
        assert np.array_equal(read_depth(tmp_path / f"desk/depth/{i:06d}.png", scale=1000.0), stored)


def test_a_published_sequence_keeps_its_times_and_unit(shared_sequence, tmp_path):
    report = convert(
        shared_sequence("rgbd_dataset_freiburg1_rpy_excerpt"), tmp_path / "rpy", options=ConvertOptions(every=6)
    )
    assert (report.depth_scale, report.has_poses, report.dropped) == (5000, True, {})
    times = [float(line.split()[1]) for line in (tmp_path / "rpy/times.txt").read_text().splitlines()[1:]]
    assert np.all(np.abs(np.diff(times) - 0.2) < 0.02)
    assert not any("are not times" in note for note in report.notes)
