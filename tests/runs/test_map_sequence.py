import dataclasses
import importlib
import itertools
import json
import math
import re
import signal
from typing import Any

import pytest
import torch

from gsfusion_nb.config import gps_slam, gsfusion, replace, rtg_slam
from gsfusion_nb.data import BadFrameError, SequenceError, apply_options
from gsfusion_nb.evaluation import score_view
from gsfusion_nb.export import read_gaussian_ply, read_mesh_ply, read_trajectory_tum
from gsfusion_nb.mapping import GPSSLAM, RTGSLAM, GSFusion
from gsfusion_nb.runs import MappingRun, rescore, resume_mapping, run_mapping, scored_views
from gsfusion_nb.runs.scores import score_mesh
from gsfusion_nb.seeding import SeedContext
from gsfusion_nb.types import Seeds

ROOM: dict[str, Any] = {"n_frames": 120, "width": 80, "height": 60}


class Damaged:
    """A sequence some of whose frames cannot be read."""

    def __init__(self, source, bad: set[int]):
        self.source = source
        self.bad = bad
        self.name = "damaged"
        self.camera = source.camera

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


def test_a_run_leaves_all_files_and_the_numbers_agree(tmp_path, config, run_files):
    run = run_mapping("room", config, folder=tmp_path / "out", **ROOM)
    assert {p.name for p in run.folder.iterdir()} == run_files
    params = read_gaussian_ply(run.folder / "gaussians.ply")
    ours = run.mapper.gaussians.params
    torch.testing.assert_close(params.xyz_W, ours.xyz_W)
    assert (run.folder / "gaussians.ply").stat().st_size == pytest.approx(248 * len(ours), abs=3000)
    mesh = read_mesh_ply(run.folder / "mesh.ply")
    assert len(mesh.faces) == run.metrics["n_triangles"] > 500
    stamps, poses = read_trajectory_tum(run.folder / "trajectory.txt")
    assert len(stamps) == len(poses) == run.metrics["n_frames"] == 9
    torch.testing.assert_close(
        poses[3].float(),
        run.run.poses[3],
        atol=1e-5,
        rtol=0,
    )
    metrics = json.loads((run.folder / "metrics.json").read_text())
    assert metrics["status"] == "complete"
    assert len(metrics["frames"]) == 9
    assert metrics["metrics"]["psnr_held_out_db"] == run.metrics["psnr_held_out_db"] > 14
    assert metrics["metrics"]["psnr_held_out_db"] > metrics["metrics"]["psnr_held_out_online_db"]
    assert metrics["metrics"]["mesh_accuracy_m"] < 0.04  # a voxel
    assert metrics["metrics"]["mesh_psnr_held_out_db"] > 12
    assert "not requested" in metrics["metrics"]["lpips_held_out"]["not_computed"]
    page = (run.folder / "report.html").read_text()
    assert not re.search(r"(src|href)=\"?https?:", page)
    assert page.count("data:image") >= 6

    again = rescore(run.folder)
    # the map on disk is float32 as in memory, so its scores are the same
    assert again["psnr_mapped_db"] == run.metrics["psnr_mapped_db"]


def test_maps_lie_where_the_surfaces_are(whole_run, run_files):
    from gsfusion_nb.data.room import room_sdf

    mesh = whole_run.mapper.mesh()
    assert room_sdf(mesh.vertices_W).abs().median() < 0.01
    assert room_sdf(whole_run.mapper.gaussians.params.xyz_W).abs().median() < 0.02
    assert {p.name for p in whole_run.folder.iterdir()} == run_files - {"report.html"}


def test_a_bad_frame_in_the_middle_is_skipped_and_named(tmp_path, small_room, config):
    run = run_mapping(Damaged(small_room, {3, 4}), config, folder=tmp_path / "out")
    assert run.run.status == "complete"
    assert len(run.run.steps) == 7
    assert (
        run.run.warnings[0] == "skipped a frame: rgb/000003.png is truncated; expected a whole PNG"
    )
    assert "rgb/000004.png" in (run.folder / "report.html").read_text()
    assert json.loads((run.folder / "metrics.json").read_text())["warnings"] == run.run.warnings


def test_a_recording_that_breaks_off_keeps_what_was_mapped(tmp_path, small_room, config):
    long = replace(config, data__stop=60)
    run = run_mapping(
        Damaged(small_room, set(range(5, 60))),
        long,
        folder=tmp_path / "out",
        evaluate=False,
    )
    assert run.run.status == "stopped"
    assert "stopped after 21 unusable frames in a row" in run.run.warnings[-1]
    assert len(read_gaussian_ply(run.folder / "gaussians.ply")) == len(run.mapper.gaussians) > 0


def test_ctrl_c_saves_everything_and_the_run_can_go_on(
    tmp_path, small_room, config, monkeypatch, run_files, whole_run
):
    open_small(monkeypatch, Interrupting(small_room, {5}))
    stopped = run_mapping("room", config, folder=tmp_path / "out", **ROOM)
    assert stopped.run.status == "interrupted"
    assert len(stopped.run.steps) == 5  # frames 0, 1, 3, 4 and the one that was being read
    assert "interrupted after 5 of 9 frames" in stopped.run.warnings[-1]
    assert {p.name for p in stopped.folder.iterdir()} == run_files | {"checkpoint"}

    resumed = resume_mapping(stopped.folder, evaluate=False)
    assert resumed.run.status == "complete"
    assert not (stopped.folder / "checkpoint").exists()
    assert len(resumed.run.steps) == 9
    ours = resumed.mapper.gaussians.params
    expected = whole_run.mapper.gaussians.params
    for name in ("xyz_W", "sh"):
        assert torch.equal(getattr(ours, name), getattr(expected, name))


def open_small(monkeypatch, sequence):
    from gsfusion_nb.runs import map_sequence, resume

    for module in (map_sequence, resume):
        monkeypatch.setattr(
            module, "open_sequence", lambda path_or_name, data, **_: apply_options(sequence, data)
        )


def test_a_pass_cut_short_goes_on_where_it_was(
    tmp_path, small_room, config, monkeypatch, whole_run
):
    open_small(monkeypatch, small_room)
    step = GSFusion._optimise_view
    calls = []

    def interrupting(self, view, ssim_weight=0.0, **others):
        calls.append(ssim_weight)
        if calls.count(0.2) == 3:
            signal.raise_signal(signal.SIGTERM)
        return step(self, view, ssim_weight, **others)

    monkeypatch.setattr(GSFusion, "_optimise_view", interrupting)
    stopped = run_mapping("room", config, folder=tmp_path / "out")
    monkeypatch.setattr(GSFusion, "_optimise_view", step)
    assert stopped.run.status == "interrupted"
    assert 0 < len(stopped.mapper.passes.queue) < len(stopped.mapper.keyframes)
    resumed = resume_mapping(stopped.folder)
    assert not any("interrupted" in w for w in resumed.run.warnings)
    assert torch.equal(resumed.mapper.gaussians.params.sh, whole_run.mapper.gaussians.params.sh)
    assert len(resumed.run.global_passes.losses) == 2
    for key in ("psnr_held_out_online_db", "psnr_mapped_online_db"):
        assert resumed.metrics[key] == stopped.metrics[key]
    assert resumed.metrics["psnr_mapped_online_db"] < resumed.metrics["psnr_mapped_db"]


def test_a_rule_that_fails_in_the_middle_loses_nothing(tmp_path, small_room, config):
    def fails_later(ctx: SeedContext, *, at: int = 4) -> Seeds:
        """Raise at a later frame."""
        if ctx.frame.index == at:
            raise RuntimeError("my rule is broken")
        return ctx.cells()

    with pytest.raises(RuntimeError, match="my rule is broken") as failure:
        run_mapping(small_room, config, folder=tmp_path / "out", seeding=fails_later)
    assert "The 3 frames mapped before are saved in" in failure.value.__notes__[0]
    assert len(read_gaussian_ply(tmp_path / "out" / "gaussians.ply")) > 0
    document = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert document["status"] == "failed"
    assert "my rule is broken" in document["warnings"][-1]


@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam", "gps_slam"])
def test_a_full_memory_ends_the_run_with_everything_saved(
    system, tmp_path, small_room, monkeypatch
):
    """The mesh does not fit any more either: it is left out."""
    mapper = {"gsfusion": GSFusion, "rtg_slam": RTGSLAM, "gps_slam": GPSSLAM}[system]
    step = mapper.step

    def full(self, *args):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")

    def fails_later(self, frame):
        return full(self) if frame.index == 4 else step(self, frame)

    monkeypatch.setattr(mapper, "step", fails_later)
    monkeypatch.setattr(mapper, "mesh", full)
    data = {"width": 0, "height": 0, "hold_out_every": 0}
    config = {"gsfusion": gsfusion, "rtg_slam": rtg_slam, "gps_slam": gps_slam}[system](
        "room", data=data
    )
    with pytest.raises(MemoryError) as failure:
        run_mapping(small_room, config, folder=tmp_path / "out")
    message = str(failure.value)
    knobs = [
        "the memory of cpu is full",
        "Gaussians",
        "keyframes",
        "data.width",
        "keyframes_on = 'cpu'",
    ]
    voxels = ["voxel blocks", "tsdf.voxel_size_m"]
    own = {"gsfusion": [*voxels, "quadtree_threshold"], "rtg_slam": ["share"], "gps_slam": voxels}[
        system
    ]
    assert all(
        part in message for part in [*knobs, *own, "The 4 frames mapped before are saved in"]
    ), message
    # GPS-SLAM makes its first Gaussians in the eleventh frame
    assert (len(read_gaussian_ply(tmp_path / "out" / "gaussians.ply")) > 0) == (
        system != "gps_slam"
    )
    assert (tmp_path / "out" / "trajectory.txt").read_text().count("\n") >= 3
    assert b"element face 0" in (tmp_path / "out" / "mesh.ply").read_bytes()
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["status"] == "failed"


def test_when_no_frame_can_be_used_the_first_reason_is_the_error(tmp_path, small_room, config):
    with pytest.raises(
        SequenceError,
        match=r"none of the 9 frames could be mapped, the first because rgb/000000\.png",
    ):
        run_mapping(Damaged(small_room, set(range(12))), config, folder=tmp_path / "out")


class Odd(Damaged):
    """Depth in another unit, and a camera a thousand kilometres away at some frames."""

    def __init__(self, source, far_away: set[int], factor: float = 1.0):
        super().__init__(source, far_away)
        self.factor = factor

    def __getitem__(self, i: int):
        frame = self.source[i]
        T_WC = frame.T_WC.clone()
        T_WC[:3, 3] += 1e6 * (i in self.bad)
        return dataclasses.replace(frame, depth_m=frame.depth_m * self.factor, T_WC=T_WC)


def test_depth_out_of_range_is_named(tmp_path, small_room, config):
    run = run_mapping(
        Odd(small_room, set(), 1000.0), config, folder=tmp_path / "out", evaluate=False
    )
    assert any(
        "no depth between tsdf.near_m 0.4 and tsdf.far_m 6 m (its median is" in w
        for w in run.run.warnings
    )


def test_a_view_whose_render_has_a_nan_is_said_everywhere(
    tmp_path, small_room, config, split, monkeypatch
):
    """In the numbers, the warnings and the report."""

    def scored(view, frame, **options):
        if frame.index == split.mapping.positions[1]:
            view = dataclasses.replace(view, rgb=torch.full_like(view.rgb, math.nan))
        return score_view(view, frame, **options)

    monkeypatch.setattr(scored_views, "score_view", scored)
    run_mapping(small_room, config, folder=tmp_path / "run")
    document = json.loads((tmp_path / "run/metrics.json").read_text())
    assert document["metrics"]["n_views_nan_mapped"] == 1
    text = "1 of the views mapped have a render with a NaN: no mean of scores counts them"
    assert text in document["warnings"]
    page = (tmp_path / "run/report.html").read_text()
    assert text in page
    assert "Views with a NaN" in page


def test_a_camera_too_far_away_is_skipped_by_both_systems(tmp_path, small_room, config):
    data: dict[str, Any] = {
        "data__stop": 6,
        "data__hold_out_every": 0,
        "data__width": 0,
        "data__height": 0,
    }
    for settings in (replace(config, **data), rtg_slam("room", **data)):
        folder = tmp_path / type(settings).__name__
        run = run_mapping(Odd(small_room, {4}), settings, folder=folder, evaluate=False)
        assert len(run.run.steps) == 5
        assert (
            "frame 4 cannot be mapped: T_WC of frame 4 must be within 10 km" in run.run.warnings[0]
        )


def test_an_empty_map_says_why(tmp_path, small_room, config):
    def nothing(ctx: SeedContext) -> Seeds:
        """No seeds."""
        return ctx.cells()[:0]

    short = replace(config, data__stop=3)
    run = run_mapping(small_room, short, folder=tmp_path / "a", seeding=nothing)
    assert (
        "no Gaussians: the seeding rule 'nothing' proposed none for any of the"
        in run.run.warnings[-1]
    )
    assert run.run.warnings[-1] in (tmp_path / "a" / "metrics.json").read_text()


def test_pressing_twice_does_not_lose_the_map(tmp_path, small_room, config):
    class Impatient(Interrupting):
        """Presses twice."""

        def __getitem__(self, i: int):
            if i in self.bad:
                signal.raise_signal(signal.SIGINT)
            return super().__getitem__(i)

    run = run_mapping(
        Impatient(small_room, {5}),
        config,
        folder=tmp_path / "out",
        evaluate=False,
    )
    assert run.run.status == "interrupted"
    assert (run.folder / "checkpoint").exists()


def test_rescoring_an_interrupted_run_scores_what_was_mapped(
    tmp_path, small_room, config, monkeypatch
):
    open_small(monkeypatch, Interrupting(small_room, {5}))
    run = run_mapping("room", config, folder=tmp_path / "out")
    module = importlib.import_module("gsfusion_nb.runs.rescore")
    monkeypatch.setattr(
        module, "open_sequence", lambda path_or_name, data: apply_options(small_room, data)
    )
    again = rescore(run.folder)
    assert again["n_views_mapped"] == 5
    assert again["psnr_mapped_db"] == run.metrics["psnr_mapped_db"]


def test_damaged_files_of_a_run_are_named(tmp_path):
    (tmp_path / "checkpoint").mkdir()
    (tmp_path / "checkpoint" / "000001.json").write_bytes(b"nonsense")
    with pytest.raises(ValueError, match=r"000001\.json cannot be used"):
        resume_mapping(tmp_path)
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(ValueError, match=r"config.json must hold an object at the key source"):
        rescore(tmp_path)


def test_an_earlier_run_is_never_overwritten(tmp_path, config):
    (tmp_path / "keep.txt").write_text("precious")
    with pytest.raises(FileExistsError, match="must be a new or empty folder"):
        run_mapping("room", config, folder=tmp_path, **ROOM)
    with pytest.raises(FileNotFoundError, match="holds no checkpoint"):
        resume_mapping(tmp_path)


def test_an_option_that_the_rule_does_not_have_is_refused_before_there_is_a_folder(
    tmp_path, config, capsys
):
    from gsfusion_nb.cli import main

    folder = tmp_path / "run"
    command = [
        "map",
        "room",
        "--seeding.rule",
        "uniform",
        "--rule-options",
        "fration=0.2",
        "--out",
        str(folder),
    ]
    assert main(command) == 1
    said = capsys.readouterr().err
    assert "'uniform' has no options ['fration']; known: ['coverage', 'fraction'" in said
    assert "unexpected error" not in said
    assert not folder.exists()


def test_a_tracked_map_of_the_room_is_compared_with_its_true_surface(small_room, config):
    """Tracked frames are read as a corrected sequence, which hides what the room itself knows."""
    tracked = replace(config, tracking__poses="tracked")
    run = MappingRun(apply_options(small_room, tracked.data), GSFusion(tracked))
    for _ in itertools.islice(run.online(), 3):
        pass
    scores = score_mesh(run, run.mapper.mesh(), n_samples=2_000)
    assert scores["mesh_accuracy_m"] < 0.05
    assert scores["mesh_completion_m"] < 0.2
