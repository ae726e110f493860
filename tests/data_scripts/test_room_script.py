"""The built-in room, written in every layout and read back by each reader."""

import numpy as np
import pytest
import torch

from gsfusion_nb.data import open_sequence
from gsfusion_nb.data.room import render_room, room, room_mesh
from gsfusion_nb.export import read_mesh_ply

N = 2


@pytest.fixture
def written(script, tmp_path, capsys):
    """``written(layout)``: the folder that the script wrote, and what it printed."""

    def write(layout: str, *options: str):
        out, module = tmp_path / "data", script("room")
        module.room_mesh = lambda resolution_m, seed: room_mesh(10 * resolution_m, seed=seed)  # quicker
        arguments = [layout, "--frames", str(N), "--width", "96", "--height", "72", "--out", str(out), *options]
        assert module.main(arguments) == 0
        (folder,) = (p for p in out.iterdir() if p.name.startswith("room-"))
        return folder, capsys.readouterr().out

    return write


def same_poses(sequence):
    source = room(n_frames=N)
    frames = {frame.index: frame for frame in sequence}
    for i, frame in frames.items():
        torch.testing.assert_close(frame.T_WC, source.pose(i), atol=2e-6, rtol=0)
    return [frames[i] for i in sorted(frames)]


def same_views(frames, *, depth_step_m: float, grey: float):
    """Depth within half a step, colour within the layout's compression, of the room as that camera sees it."""
    for frame in frames:
        rgb, depth_m = render_room(frame.camera, frame.T_WC)
        assert float((frame.depth_m - depth_m).abs().median()) <= 0.51 * depth_step_m
        # the poses on disk are rounded, so that a silhouette may move by a pixel here and there
        assert float(((frame.depth_m - depth_m).abs() < depth_step_m).float().mean()) > 0.999
        error = (frame.rgb - rgb).abs() * 255
        assert float(error.mean()) < grey


def test_folder_is_lossless(written):
    folder, text = written("folder")
    assert f"gsfusion-nb map {folder} --preset replica" in text
    source = room(n_frames=N, width=96, height=72)
    for i, frame in enumerate(open_sequence(folder)):
        original = source[i]
        assert vars(frame.camera) == pytest.approx(vars(original.camera))
        torch.testing.assert_close(frame.rgb, original.rgb, atol=1e-6, rtol=0)
        torch.testing.assert_close(frame.depth_m, original.depth_m, atol=1e-6, rtol=0)
    same_poses(open_sequence(folder))
    assert read_mesh_ply(folder / "mesh.ply").faces.shape[0] > 1000


def test_replica(written):
    folder, text = written("replica")
    assert f"gsfusion-nb map {folder} --preset replica" in text
    sequence = open_sequence(folder)
    assert vars(sequence.camera) == pytest.approx(vars(room(width=96, height=72).camera))
    same_views(same_poses(sequence), depth_step_m=1 / 6553.5, grey=2)


def test_tum(written):
    folder, text = written("tum")
    assert f"gsfusion-nb map {folder} --preset tum" in text
    frames = same_poses(open_sequence(folder))
    assert len(frames) == N
    same_views(frames, depth_step_m=1 / 5000, grey=0.51)


def test_seven_scenes(written):
    folder, text = written("seven_scenes")
    assert f"gsfusion-nb map {folder}/seq-01 --preset tum --reader register=true" in text
    for frame in same_poses(open_sequence(folder)):  # the depth camera's frames: colour is another camera's
        _, depth_m = render_room(frame.camera, frame.T_WC)
        assert float(((frame.depth_m - depth_m).abs() < 0.001).float().mean()) > 0.999
    for frame in open_sequence(folder, register=True):
        rgb, depth_m = render_room(frame.camera, frame.T_WC)
        assert float(((frame.rgb - rgb).abs() * 255).mean()) < 3  # two resamplings
        seen = frame.depth_m > 0
        assert float((frame.depth_m - depth_m).abs()[seen].median()) < 0.003  # warping rounds to whole pixels
        assert float(seen.float().mean()) > 0.6


def test_scannetpp(written):
    folder, text = written("scannetpp")
    assert f"gsfusion-nb map {folder} --preset scannetpp" in text
    sequence = open_sequence(folder)
    assert vars(sequence.camera) == pytest.approx(vars(room(width=96, height=72).camera))
    same_views(same_poses(sequence), depth_step_m=1 / 1000, grey=2)
    assert np.all([frame.index == i for i, frame in enumerate(sequence)])
