"""A run that is stopped, or cut off, leaves what is needed to go on."""

import importlib
import json
import os
import signal
from typing import Any

import pytest
import torch

from gsfusion_nb.config import gsfusion, rtg_slam
from gsfusion_nb.data import apply_options
from gsfusion_nb.mapping import GSFusion, make_mapper
from gsfusion_nb.mapping.frame_guard import FrameGuard
from gsfusion_nb.runs import (
    CheckpointEvery,
    StreamRun,
    driver,
    outputs,
    resume_mapping,
    run_mapping,
    scores,
)
from gsfusion_nb.runs.checkpoint import save_checkpoint
from gsfusion_nb.runs.run_folder import Autosave, is_complete


@pytest.fixture
def small(monkeypatch, small_room):
    """ "room" opens the small room."""
    for name in ("map_sequence", "resume"):
        module = importlib.import_module(f"gsfusion_nb.runs.{name}")
        monkeypatch.setattr(
            module, "open_sequence", lambda path_or_name, data, **_: apply_options(small_room, data)
        )
    return small_room


def metrics_of(folder) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def test_a_stop_while_scoring_leaves_a_report_and_the_run_can_be_scored_again(
    tmp_path, small, config, monkeypatch, whole_run
):
    score_mesh = scores.score_mesh

    def stopped(run, mesh):
        signal.raise_signal(signal.SIGTERM)
        return score_mesh(run, mesh)

    monkeypatch.setattr(scores, "score_mesh", stopped)
    run = run_mapping("room", config, folder=tmp_path / "out")
    monkeypatch.setattr(scores, "score_mesh", score_mesh)
    assert run.run.status == "interrupted"
    assert "psnr_held_out_db" in metrics_of(run.folder)["metrics"]
    assert "mesh_accuracy_m" not in metrics_of(run.folder)["metrics"]
    assert run.run.warnings == ["interrupted while the views were scored; the maps are complete"]
    assert "interrupted while the views were scored" in (run.folder / "report.html").read_text()
    assert (run.folder / "checkpoint").is_dir()
    again = resume_mapping(run.folder)
    assert (again.run.status, again.run.warnings) == ("complete", [])
    assert "mesh_accuracy_m" in metrics_of(run.folder)["metrics"]
    assert again.run.hashes == whole_run.run.hashes == run.run.hashes
    assert not (run.folder / "checkpoint").exists()


def test_killed_while_the_maps_are_written_or_scored_a_run_goes_on(
    tmp_path, small, config, monkeypatch, whole_run
):
    """Also before its first checkpoint by time; metrics.json says "complete" only when nothing is
    left to do."""

    class Killed(BaseException):
        pass

    def killed(*_, **__):
        raise Killed

    at = {"write_gaussian_ply": lambda: run_mapping("room", config, folder=tmp_path / "out")}
    at |= dict.fromkeys(("score_mesh", "write_page"), lambda: resume_mapping(tmp_path / "out"))
    for name, go_on in at.items():
        with monkeypatch.context() as patch:
            module = scores if name == "score_mesh" else outputs
            patch.setattr(module, name, killed)
            patch.setattr(driver, "_rescue", lambda *_: None)
            with pytest.raises(Killed):
                go_on()
        assert not is_complete(tmp_path / "out")
        (tmp_path / "out" / f".mesh.0011223{len(name) % 10}.partial.ply").touch()
        with pytest.raises(FileExistsError, match="--resume"):
            run_mapping("room", config, folder=tmp_path / "out")
    again = resume_mapping(tmp_path / "out")
    assert again.run.hashes == whole_run.run.hashes
    assert is_complete(again.folder)
    assert "mesh_accuracy_m" in metrics_of(again.folder)["metrics"]
    assert not list(again.folder.glob("*.partial*"))
    with pytest.raises(FileNotFoundError, match="nothing to continue"):
        resume_mapping(again.folder)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork and users")
def test_a_folder_that_may_not_be_written_is_named_before_anything_is_mapped(
    tmp_path, small, config
):
    """As another user, because root may write everywhere."""
    (tmp_path / "closed").mkdir()
    (tmp_path / "closed").chmod(0o555)
    for parent in (tmp_path, *list(tmp_path.parents)[:2]):
        parent.chmod(0o755)
    read, write = os.pipe()
    pid = os.fork()
    if not pid:
        try:
            if os.getuid() == 0:
                os.setgid(65534)
                os.setuid(65534)
            run_mapping("room", config, folder=tmp_path / "closed" / "out")
        except BaseException as e:
            os.write(write, f"{type(e).__name__} {e}".encode())
        os._exit(0)
    os.close(write)
    os.waitpid(pid, 0)
    with os.fdopen(read) as said:
        text = said.read()
    assert text.startswith("PermissionError")
    assert str(tmp_path / "closed" / "out") in text


@pytest.mark.parametrize("at_frame", [0, 3])
def test_sigterm_between_two_gradient_steps_undoes_the_frame_and_the_run_resumes(
    tmp_path, small, monkeypatch, at_frame
):
    """RTG-SLAM takes many steps for a frame. The first frame is mapped to its end, so that there is
    a map."""
    data: dict[str, Any] = {
        "data__width": 32,
        "data__height": 24,
        "data__stop": 5,
        "data__hold_out_every": 0,
    }
    config = rtg_slam(
        "room",
        window__every_frames=1,
        window__iterations=6,
        final__passes=1,
        mesh_voxel_m=0.1,
        **data,
    )
    may_stop = FrameGuard.may_stop
    looks = []

    def stopped(guard):
        looks.append(guard._index)
        if looks.count(at_frame) == 3:
            signal.raise_signal(signal.SIGTERM)
        may_stop(guard)

    with monkeypatch.context() as patch:
        patch.setattr(FrameGuard, "may_stop", stopped)
        run = run_mapping("room", config, folder=tmp_path / "out", evaluate=False)
    assert run.run.status == "interrupted"
    assert looks.count(at_frame) == (3 if at_frame else 7)
    assert (
        len(run.run.steps) == run.run.mapper.n_frames == run.run.next_position == max(at_frame, 1)
    )
    assert (run.folder / "checkpoint").is_dir()
    assert not run.run.mapper.guard.stop_wanted()
    assert run.run.mapper.guard.half_mapped == ""
    if at_frame:
        whole = run_mapping("room", config, folder=tmp_path / "whole", evaluate=False)
        again = resume_mapping(run.folder, evaluate=False)
        assert again.run.status == "complete"
        assert again.run.hashes == whole.run.hashes


def test_the_checkpoint_comes_before_the_maps_and_scoring_is_cut_short(
    tmp_path, small, config, monkeypatch
):
    score = scores.score
    write_maps = outputs.write_maps
    seen = []

    def stopped(run, suffix=""):
        if suffix == "_online":
            signal.raise_signal(signal.SIGTERM)
            seen.append("the online scores went on")
        return score(run, suffix)

    def watched(run, folder):
        seen.append(sorted(p.name for p in (folder / "checkpoint").iterdir()))
        return write_maps(run, folder)

    monkeypatch.setattr(scores, "score", stopped)
    monkeypatch.setattr(outputs, "write_maps", watched)
    run = run_mapping("room", config, folder=tmp_path / "out")
    assert run.run.status == "interrupted"
    assert seen == [["000001.constants", "000001.copy", "000001.json", "000001.state"]]
    monkeypatch.undo()


def test_a_stream_that_was_killed_keeps_its_map(tmp_path, small_room, config):
    frames = [small_room[i] for i in range(10)]
    run = StreamRun(frames, make_mapper(config))
    list(run.online())
    save_checkpoint(run, tmp_path)  # and then the process is killed
    after = resume_mapping(tmp_path)
    assert after.run.status == "complete"
    assert after.mapper.n_frames == len(run.steps) == 8
    assert len(after.run.global_passes.losses) == 2
    assert after.metrics["n_views_held_out"] == 2
    assert after.run.warnings == [
        "the stream was interrupted after 8 frames, when its process was killed"
    ]
    assert {"gaussians.ply", "mesh.ply", "report.html"} <= {p.name for p in tmp_path.iterdir()}
    list(run.optimise())
    assert torch.equal(run.mapper.gaussians.params.sh, after.mapper.gaussians.params.sh)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_checkpoints_come_by_time_or_by_frames_and_take_a_small_share_of_the_time(config):
    mapper = GSFusion(gsfusion("room"))
    clock = Clock()
    saved = []

    def save():
        saved.append(clock.now)
        clock.now += 2.0

    autosave = Autosave(mapper, save, CheckpointEvery(seconds=30), clock)
    for _ in range(300):
        clock.now += 1.0
        autosave()
    assert saved[:2] == [30.0, pytest.approx(30 + 2 + 2 / 0.03, abs=1.0)]
    saved.clear()
    autosave = Autosave(mapper, save, CheckpointEvery(seconds=0, frames=4), clock)
    for _ in range(9):
        autosave()
    assert len(saved) == autosave.n_saved == 2
    for _ in range(9):
        Autosave(mapper, save, CheckpointEvery(seconds=0), clock)()
    assert len(saved) == 2
    with pytest.raises(ValueError, match="-1"):
        CheckpointEvery(seconds=-1)
