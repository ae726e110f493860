"""Recordings in the layouts of other trainers, read back by our readers of these."""

import json

import numpy as np
import pytest
import torch

from gsfusion_nb.cli import main
from gsfusion_nb.config import DataConfig
from gsfusion_nb.data import open_sequence
from gsfusion_nb.errors import SequenceError
from gsfusion_nb.recordings.baselines import LAYOUTS, write_for_baseline
from gsfusion_nb.recordings.convert.run import convert

DATA = DataConfig(hold_out_every=4, hold_out_offset=2)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_frames_come_back_as_they_were(scene, tmp_path, layout):
    sequence = open_sequence(scene, data=DATA)
    assert write_for_baseline(sequence, tmp_path / layout, layout) == len(sequence)
    convert(tmp_path / layout, tmp_path / "back", format=layout)
    back = open_sequence(tmp_path / "back", data=DATA)
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(back.camera, name) == pytest.approx(getattr(sequence.camera, name))
    for ours, theirs in zip(sequence, back, strict=True):
        torch.testing.assert_close(theirs.T_WC, ours.T_WC, atol=1e-6, rtol=1e-6)
        assert torch.equal(theirs.rgb_u8, ours.rgb_u8)
        torch.testing.assert_close(theirs.depth_m, ours.depth_m, atol=6e-4, rtol=0)


def test_held_out_views_are_named(scene, tmp_path):
    sequence = open_sequence(scene, data=DATA)
    for layout in LAYOUTS:
        write_for_baseline(sequence, tmp_path / layout, layout)
    held_out = [f"{i:06d}.png" for i in sequence.held_out.positions]
    assert len(held_out) == 2
    assert (tmp_path / "colmap/sparse/0/test.txt").read_text().split() == held_out
    document = json.loads((tmp_path / "nerfstudio/transforms.json").read_text())
    assert document["test_filenames"] == [f"images/{name}" for name in held_out]
    assert len(document["train_filenames"]) == 5
    assert len(document["frames"]) == 7


def test_points_lie_on_the_wall(scene, tmp_path):
    sequence = open_sequence(scene, data=DATA)
    depth_m = float(sequence.mapping[0].depth_m.max())
    write_for_baseline(sequence, tmp_path / "colmap", "colmap")
    rows = np.loadtxt(tmp_path / "colmap/sparse/0/points3D.txt")
    assert len(rows) > 1000
    assert np.abs(rows[:, 3] - depth_m).max() < 1e-3
    write_for_baseline(sequence, tmp_path / "nerfstudio", "nerfstudio")
    from plyfile import PlyData

    vertices = PlyData.read(tmp_path / "nerfstudio/sparse_pc.ply")["vertex"]
    assert np.allclose(vertices["z"], rows[:, 3], atol=1e-5)
    assert np.array_equal(vertices["red"], rows[:, 4])


def test_the_command_takes_frames_size_and_held_out_views(scene, tmp_path, capsys):
    command = ["excerpt", str(scene), str(tmp_path / "out"), "--layout", "nerfstudio"]
    settings = ["--set", "data.width=20", "data.hold_out_every=2", "data.hold_out_offset=0"]
    assert main([*command, "--frames", "1:6", *settings]) == 0
    assert "5 frames" in capsys.readouterr().out
    document = json.loads((tmp_path / "out/transforms.json").read_text())
    assert document["w"] == 20
    assert len(document["test_filenames"]) == 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--layout", "gaussians"], "gaussians"),
        (["--set", "data.width=20"], "keeps them"),
        (["--layout", "colmap", "--set", "sh_degree=1"], "takes settings of data here"),
    ],
)
def test_what_the_command_refuses(scene, tmp_path, capsys, words, message):
    try:
        status = main(["excerpt", str(scene), str(tmp_path / "out"), *words])
    except SystemExit as e:
        status = e.code
    assert status
    streams = capsys.readouterr()
    assert message in streams.err + streams.out


def test_a_recording_without_poses_is_refused(scene, tmp_path):
    sequence = open_sequence(scene, data=DATA)
    object.__setattr__(sequence.source, "has_poses", False)
    with pytest.raises(SequenceError, match="has no poses, which a baseline needs"):
        write_for_baseline(sequence, tmp_path / "out", "colmap")
