"""Replica in NICE-SLAM's rendering."""

import pytest
import torch

from gsfusion_nb.data import SequenceError, open_sequence, replica
from gsfusion_nb.types import Camera


def write(root, box, n=4):
    """As the other layouts' tests have it."""
    return box.replica(root, n)


def test_reads_what_was_written(tmp_path, box):
    root = box.replica(tmp_path / "office0")
    seq = replica(root)
    assert (seq.name, len(seq)) == ("office0", 4)
    assert vars(seq.camera) == pytest.approx(vars(box.camera))
    for i, frame in enumerate(seq):
        assert frame.timestamp_s == pytest.approx(i / 30)
        assert torch.allclose(
            frame.T_WC.double(),
            box.poses(4)[i],
            atol=1e-6,
        )
        assert box.off_wall_m(frame) < 0.0001  # 0.15 mm per step of depth
    assert len(open_sequence(root)) == 4


def test_default_camera(tmp_path, box):
    root = box.replica(tmp_path / "office0")
    (tmp_path / "cam_params.json").unlink()
    assert replica(root).camera == Camera(
        width=1200, height=680, fx=600.0, fy=600.0, cx=600.0, cy=340.0
    )
    with pytest.raises(SequenceError, match=r"frame000000\.jpg is 64x48; expected 1200x680"):
        replica(root)[0]


def test_a_thinned_copy_keeps_its_poses(tmp_path, box):
    seq = replica(
        box.replica(
            tmp_path / "office0",
            n=7,
            numbers=[1, 3, 6],
        )
    )
    assert [f.index for f in seq] == [0, 1, 2]
    assert torch.allclose(
        seq.pose(2).double(),
        box.poses(7)[6],
        atol=1e-6,
    )
    assert all(box.off_wall_m(f) < 0.0001 for f in seq)


def test_errors(tmp_path, box):
    root = box.replica(tmp_path / "office0")
    text = (root / "traj.txt").read_text()
    (root / "traj.txt").write_text("\n".join(text.splitlines()[:3]))
    with pytest.raises(SequenceError, match=r"traj\.txt"):
        replica(root)
    (root / "traj.txt").write_text(text)
    (tmp_path / "cam_params.json").write_text('{"camera": {"w": 64}}')
    with pytest.raises(SequenceError, match=r"cam_params\.json lacks h"):
        replica(root)
