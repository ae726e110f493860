"""Recordings that others made, as they were found: what a conversion says about them is true."""

import json

import numpy as np

from gsfusion_nb.data.readers.folder import folder
from gsfusion_nb.data.readers.tum import tum
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
        stored = read_depth(
            source / f"depths/depth{2 + 3 * i:05d}.png", scale=1000.0, invalid=(65535,)
        )
        assert np.array_equal(
            read_depth(tmp_path / f"desk/depth/{i:06d}.png", scale=1000.0), stored
        )


def test_a_published_sequence_keeps_its_times_and_unit(shared_sequence, tmp_path):
    """Those of colour and of depth, and the poses when colour was taken, as the sequence's own
    reader has them."""
    source = shared_sequence("rgbd_dataset_freiburg1_rpy_excerpt")
    report = convert(source, tmp_path / "rpy", options=ConvertOptions(every=6))
    assert (report.depth_scale, report.has_poses, report.dropped) == (5000, True, {})
    ours = folder(tmp_path / "rpy")
    theirs = tum(source)
    depth_s = ours.depth_times_s or []
    assert ours.timestamps_s == theirs.timestamps_s[::6]
    assert depth_s == (theirs.depth_times_s or [])[::6]
    assert len({round(a - b, 4) for a, b in zip(ours.timestamps_s, depth_s, strict=True)}) > 5
    for i in range(len(ours)):
        np.testing.assert_allclose(
            ours.pose(i),
            theirs.pose(6 * i),
            atol=1e-5,
        )
    assert not any("are not times" in note for note in report.notes)
