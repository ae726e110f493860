import json
import re
import signal

import pytest
import torch

from gsfusion_nb.config import replace
from gsfusion_nb.datasets import BadFrameError
from gsfusion_nb.export import read_gaussian_ply, read_mesh_ply, read_trajectory_tum
from gsfusion_nb.mapping import rescore, resume_mapping, run_mapping

FILES = {"gaussians.ply", "mesh.ply", "trajectory.txt", "config.json", "metrics.json", "report.html"}
ROOM = {"n_frames": 120, "width": 80, "height": 60}

pytestmark = pytest.mark.filterwarnings("ignore::tqdm.TqdmWarning")


class Damaged:
    """A sequence some of whose frames cannot be read."""

    def __init__(self, source, bad: set[int]):
        self.source, self.bad = source, bad
        self.name, self.camera = "damaged", source.camera

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, i: int):
        if i in self.bad:
            raise BadFrameError(f"rgb/{i:06d}.png is truncated; expected a whole PNG")
        return self.source[i]

    def pose(self, i: int):
        return self.source.pose(i)


class Interrupting(Damaged):
    """Presses Ctrl-C once, while a frame is being read."""

    def __getitem__(self, i: int):
        if i in self.bad:
            self.bad = set()
            signal.raise_signal(signal.SIGINT)
        return self.source[i]


def test_a_run_leaves_all_files_and_the_numbers_agree(tmp_path, config):
    run = run_mapping("room", config, folder=tmp_path / "out", **ROOM)
    assert {p.name for p in run.folder.iterdir()} == FILES
    params = read_gaussian_ply(run.folder / "gaussians.ply")
    ours = run.mapper.gaussians.params
    torch.testing.assert_close(params.xyz_W, ours.xyz_W)
    assert (run.folder / "gaussians.ply").stat().st_size == pytest.approx(248 * len(ours), abs=3000)
    mesh = read_mesh_ply(run.folder / "mesh.ply")
    assert len(mesh.faces) == run.metrics["n_triangles"] > 500
    stamps, poses = read_trajectory_tum(run.folder / "trajectory.txt")
    assert len(stamps) == len(poses) == run.metrics["n_frames"] == 9
    torch.testing.assert_close(poses[3].float(), run.run.poses[3], atol=1e-5, rtol=0)
    metrics = json.loads((run.folder / "metrics.json").read_text())
    assert metrics["status"] == "complete"
    assert len(metrics["frames"]) == 9
    assert metrics["metrics"]["psnr_held_out_db"] == run.metrics["psnr_held_out_db"] > 14
    assert metrics["metrics"]["psnr_held_out_db"] > metrics["metrics"]["psnr_held_out_online_db"]
    assert metrics["metrics"]["mesh_accuracy_m"] < 0.04  # a voxel
    assert "not asked for" in metrics["metrics"]["lpips_held_out"]["not_computed"]
    page = (run.folder / "report.html").read_text()
    assert not re.search(r"(src|href)=\"?https?:", page)
    assert page.count("data:image") >= 6

    again = rescore(run.folder)
    # the map on disk is float32 as in memory, so its scores are the same
    assert again["psnr_mapped_db"] == pytest.approx(run.metrics["psnr_mapped_db"], abs=1e-3)


def test_maps_lie_where_the_surfaces_are(tmp_path, config):
    from gsfusion_nb.datasets.room import room_sdf

    run = run_mapping("room", config, folder=tmp_path / "out", evaluate=False, **ROOM)
    mesh = run.mapper.mesh()
    assert room_sdf(mesh.vertices_W).abs().median() < 0.01
    assert room_sdf(run.mapper.gaussians.params.xyz_W).abs().median() < 0.02
    assert {p.name for p in run.folder.iterdir()} == FILES - {"report.html"}


def test_a_bad_frame_in_the_middle_is_skipped_and_named(tmp_path, small_room, config):
    run = run_mapping(Damaged(small_room, {3, 4}), config, folder=tmp_path / "out")
    assert run.run.status == "complete"
    assert len(run.run.steps) == 7
    assert run.run.warnings[0] == "skipped a frame: rgb/000003.png is truncated; expected a whole PNG"
    assert "rgb/000004.png" in (run.folder / "report.html").read_text()
    assert json.loads((run.folder / "metrics.json").read_text())["warnings"] == run.run.warnings


def test_a_recording_that_breaks_off_keeps_what_was_mapped(tmp_path, small_room, config):
    long = replace(config, data__stop=60)
    run = run_mapping(Damaged(small_room, set(range(5, 60))), long, folder=tmp_path / "out", evaluate=False)
    assert run.run.status == "stopped"
    assert "stopped after 21 unreadable frames in a row" in run.run.warnings[-1]
    assert len(read_gaussian_ply(run.folder / "gaussians.ply")) == len(run.mapper.gaussians) > 0


def test_ctrl_c_saves_everything_and_the_run_can_go_on(tmp_path, small_room, config, monkeypatch):
    whole = run_mapping("room", config, folder=tmp_path / "whole", evaluate=False, **ROOM)
    from gsfusion_nb.mapping import map_sequence

    monkeypatch.setattr(map_sequence, "open_sequence", lambda path_or_name, data, **_: open_interrupting(data))

    def open_interrupting(data):
        from gsfusion_nb.datasets import apply_options

        return apply_options(Interrupting(small_room, {5}), data)

    stopped = run_mapping("room", config, folder=tmp_path / "out", **ROOM)
    assert stopped.run.status == "interrupted"
    assert len(stopped.run.steps) == 5  # frames 0, 1, 3, 4 and the one that was being read
    assert "interrupted after 5 of 9 frames" in stopped.run.warnings[-1]
    assert {p.name for p in stopped.folder.iterdir()} == FILES | {"checkpoint.pt"}

    resumed = resume_mapping(stopped.folder, evaluate=False)
    assert resumed.run.status == "complete"
    assert not (stopped.folder / "checkpoint.pt").exists()
    assert len(resumed.run.steps) == 9
    for name in ("xyz_W", "sh"):
        assert torch.equal(getattr(resumed.mapper.gaussians.params, name), getattr(whole.mapper.gaussians.params, name))


def test_an_earlier_run_is_never_overwritten(tmp_path, config):
    (tmp_path / "keep.txt").write_text("precious")
    with pytest.raises(FileExistsError, match="must be a new or empty folder"):
        run_mapping("room", config, folder=tmp_path, **ROOM)
    with pytest.raises(FileNotFoundError, match="only a run that was interrupted can be resumed"):
        resume_mapping(tmp_path)
