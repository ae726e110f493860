"""A run that is stopped, or cut off, leaves what is needed to go on."""

import importlib
import json
import signal

import pytest
import torch

from gsfusion_nb.config import gsfusion
from gsfusion_nb.data import apply_options
from gsfusion_nb.mapping import GSFusion, make_mapper
from gsfusion_nb.runs import CheckpointEvery, StreamRun, outputs, resume_mapping, run_mapping
from gsfusion_nb.runs.autosave import Autosave


@pytest.fixture
def small(monkeypatch, small_room):
    """ "room" opens the small room."""
    for name in ("map_sequence", "resume"):
        module = importlib.import_module(f"gsfusion_nb.runs.{name}")
        monkeypatch.setattr(module, "open_sequence", lambda path_or_name, data, **_: apply_options(small_room, data))
    return small_room


def metrics_of(folder) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def test_a_stop_while_scoring_leaves_a_report_and_the_run_can_be_scored_again(tmp_path, small, config, monkeypatch):
    whole = run_mapping("room", config, folder=tmp_path / "whole", evaluate=False)
    score_mesh = outputs.score_mesh

    def stopped(run, mesh):
        signal.raise_signal(signal.SIGTERM)
        return score_mesh(run, mesh)

    monkeypatch.setattr(outputs, "score_mesh", stopped)
    run = run_mapping("room", config, folder=tmp_path / "out")
    monkeypatch.setattr(outputs, "score_mesh", score_mesh)
    assert run.run.status == "interrupted"
    assert "psnr_held_out_db" in metrics_of(run.folder)["metrics"]
    assert "mesh_accuracy_m" not in metrics_of(run.folder)["metrics"]
    assert run.run.warnings == ["interrupted while the views were scored; the maps are complete"]
    assert "interrupted while the views were scored" in (run.folder / "report.html").read_text()
    assert (run.folder / "checkpoint").is_dir()
    again = resume_mapping(run.folder)
    assert (again.run.status, again.run.warnings) == ("complete", [])
    assert "mesh_accuracy_m" in metrics_of(run.folder)["metrics"]
    assert again.run.hashes == whole.run.hashes == run.run.hashes
    assert not (run.folder / "checkpoint").exists()


def test_the_checkpoint_comes_before_the_maps_and_scoring_is_cut_short(tmp_path, small, config, monkeypatch):
    score, write_maps, seen = outputs.score, outputs.write_maps, []

    def stopped(run, suffix=""):
        if suffix == "_online":
            signal.raise_signal(signal.SIGTERM)
            seen.append("the online scores went on")
        return score(run, suffix)

    def watched(run, folder):
        seen.append(sorted(p.name for p in (folder / "checkpoint").iterdir()))
        return write_maps(run, folder)

    monkeypatch.setattr(outputs, "score", stopped)
    monkeypatch.setattr(outputs, "write_maps", watched)
    run = run_mapping("room", config, folder=tmp_path / "out")
    assert run.run.status == "interrupted"
    assert seen == [["000001.json", "000001.pieces"]]
    monkeypatch.undo()


def test_a_stream_that_was_killed_keeps_its_map(tmp_path, small_room, config):
    frames = [small_room[i] for i in range(10)]
    run = StreamRun(frames, make_mapper(config))
    list(run.online())
    run.save_checkpoint(tmp_path)  # and then the process is killed
    after = resume_mapping(tmp_path)
    assert after.run.status == "complete"
    assert after.mapper.n_frames == len(run.steps) == 8
    assert len(after.run.global_losses) == 2
    assert after.metrics["n_views_held_out"] == 2
    assert after.run.warnings == ["the stream was interrupted after 8 frames, when its process was killed"]
    assert {"gaussians.ply", "mesh.ply", "report.html"} <= {p.name for p in tmp_path.iterdir()}
    list(run.optimise())
    assert torch.equal(run.mapper.gaussians.params.sh, after.mapper.gaussians.params.sh)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_checkpoints_come_by_time_or_by_frames_and_take_a_small_share_of_the_time(config):
    mapper, clock, saved = GSFusion(gsfusion("room")), Clock(), []

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
    with pytest.raises(ValueError, match="must be at least 0 s and 0 frames, got -1 s"):
        CheckpointEvery(seconds=-1)
