"""Replica in NICE-SLAM's rendering."""

import json

import pytest
import torch

from gsfusion_nb.data import SequenceError, open_sequence, replica
from gsfusion_nb.types import Camera


def write(root, box, n=4, numbers=None):
    """The public layout; cam_params.json lies above the scene, as in the archive."""
    for i in numbers or range(n):
        T = box.poses(n)[i]
        box.write_pair(root / f"results/frame{i:06d}.jpg", root / f"results/depth{i:06d}.png", T, 6553.5)
    lines = [" ".join(f"{v:.18e}" for v in T.flatten().tolist()) for T in box.poses(n)]
    (root / "traj.txt").write_text("\n".join(lines))
    c = box.camera
    values = {"w": c.width, "h": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx - 0.5, "cy": c.cy - 0.5, "scale": 6553.5}
    (root.parent / "cam_params.json").write_text(json.dumps({"camera": values}))
    return root


def test_reads_what_was_written(tmp_path, box):
    root = write(tmp_path / "office0", box)
    seq = replica(root)
    assert (seq.name, len(seq)) == ("office0", 4)
    assert vars(seq.camera) == pytest.approx(vars(box.camera))
    for i, frame in enumerate(seq):
        assert frame.timestamp_s == pytest.approx(i / 30)
        assert torch.allclose(frame.T_WC.double(), box.poses(4)[i], atol=1e-6)
        assert box.off_wall_m(frame) < 0.0001  # 0.15 mm per step of depth
    assert len(open_sequence(root)) == 4


def test_default_camera(tmp_path, box):
    root = write(tmp_path / "office0", box)
    (tmp_path / "cam_params.json").unlink()
    assert replica(root).camera == Camera(width=1200, height=680, fx=600.0, fy=600.0, cx=600.0, cy=340.0)
    with pytest.raises(SequenceError, match=r"frame000000\.jpg is 64x48; expected 1200x680"):
        replica(root)[0]


def test_a_thinned_copy_keeps_its_poses(tmp_path, box):
    seq = replica(write(tmp_path / "office0", box, n=7, numbers=[1, 3, 6]))
    assert [f.index for f in seq] == [0, 1, 2]
    assert torch.allclose(seq.pose(2).double(), box.poses(7)[6], atol=1e-6)
    assert all(box.off_wall_m(f) < 0.0001 for f in seq)


def test_errors(tmp_path, box):
    root = write(tmp_path / "office0", box)
    text = (root / "traj.txt").read_text()
    (root / "traj.txt").write_text("\n".join(text.splitlines()[:3]))
    with pytest.raises(SequenceError, match=r"traj\.txt"):
        replica(root)
    (root / "traj.txt").write_text(text)
    (tmp_path / "cam_params.json").write_text('{"camera": {"w": 64}}')
    with pytest.raises(SequenceError, match=r"cam_params\.json lacks h"):
        replica(root)
