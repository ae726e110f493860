"""Frames at the poses of the map: given, tracked, and in between."""

import dataclasses
import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.config import (
    DataConfig,
    RepairConfig,
    TrackingConfig,
    gps_slam,
    gsfusion,
    replace,
    rtg_slam,
)
from gsfusion_nb.data import (
    BadFrameError,
    SequenceError,
    SequenceNotFoundError,
    apply_options,
    open_sequence,
    repaired,
)
from gsfusion_nb.geometry import se3
from gsfusion_nb.mapping.localiser import Localiser
from gsfusion_nb.runs import MappingRun, rescore, run_mapping
from gsfusion_nb.runs.outputs import report_views
from gsfusion_nb.runs.poses_in_map import frames_in_map, ground_truth_poses, readable_frames
from gsfusion_nb.runs.scored_views import read_views
from gsfusion_nb.runs.scores import score_trajectory
from gsfusion_nb.types import Camera, Frame

CAMERA = Camera(
    width=8,
    height=6,
    fx=8.0,
    fy=8.0,
    cx=4.0,
    cy=3.0,
)


class Walk:
    """Ten frames along x, one of them damaged."""

    name = "path"
    camera = CAMERA
    damaged = 7

    def __len__(self) -> int:
        return 10

    def pose(self, i: int) -> torch.Tensor:
        T = se3.exp(torch.tensor([0.1 * i, 0.0, 0.02 * i, 0.0, 0.05 * i, 0.0]))
        return T

    def __getitem__(self, i: int) -> Frame:
        if i == self.damaged:
            raise BadFrameError(f"frame {i} is damaged")
        picture = torch.full((6, 8, 3), 0.5)
        return Frame(
            index=i,
            timestamp_s=0.0,
            rgb=picture,
            depth_m=torch.ones(6, 8),
            camera=CAMERA,
            T_WC=self.pose(i),
        )


@pytest.fixture
def views():
    # 2 and 6 are held out
    return apply_options(Walk(), DataConfig(hold_out_every=4, hold_out_offset=2))


def localiser(poses: str, moved: dict[int, torch.Tensor]) -> Localiser:
    found = Localiser(TrackingConfig(poses=poses))  # pyright: ignore[reportArgumentType]
    found.trajectory.frame_indices = list(moved)
    found.trajectory.poses = list(moved.values())
    return found


MOTION = se3.exp(torch.tensor([0.5, -0.2, 0.1, 0.3, 0.1, -0.2]))


def test_damaged_frames_are_left_out(views):
    assert [f.index for f in readable_frames(views.mapping)] == [0, 1, 3, 4, 5, 8, 9]


def test_given_poses_stay(views):
    found = localiser("given", {0: MOTION})
    for frame in frames_in_map(views.mapping, found, views.mapping):
        assert torch.equal(frame.T_WC, Walk().pose(frame.index))


def test_a_mapped_frame_has_its_tracked_pose_and_others_follow_the_nearest(views):
    """The tracked world is the data's, moved; so every frame comes out moved alike."""
    tracked = {i: MOTION @ Walk().pose(i) for i in (0, 1, 3, 5, 8)}
    # an error of tracking
    tracked[8] = tracked[8] @ se3.exp(torch.tensor([0.01, 0.0, 0.0, 0.0, 0.0, 0.0]))
    found = localiser("tracked", tracked)
    for frame in frames_in_map(views.mapping, found, views.mapping):
        if frame.index in tracked:
            assert torch.equal(frame.T_WC, tracked[frame.index])
    by_index = {f.index: f.T_WC for f in frames_in_map(views.held_out, found, views.mapping)}
    assert set(by_index) == {2, 6}
    for i, T_WC in by_index.items():
        torch.testing.assert_close(
            T_WC,
            MOTION @ Walk().pose(i),
            atol=1e-5,
            rtol=0,
        )
    late = {f.index: f.T_WC for f in frames_in_map(views.mapping, found, views.mapping)}
    # nearest is 8, with its error
    expected = tracked[8] @ se3.inverse(Walk().pose(8)) @ Walk().pose(9)
    torch.testing.assert_close(late[9], expected, atol=1e-5, rtol=0)


def test_ground_truth_poses_of_the_mapped_frames(views):
    found = localiser("tracked", dict.fromkeys((0, 3, 9), MOTION))
    truth = ground_truth_poses(found.trajectory.frame_indices, views.mapping)
    assert truth is not None
    assert torch.equal(
        truth,
        torch.stack([Walk().pose(i) for i in (0, 3, 9)]),
    )


def test_the_true_poses_count_more_than_those_of_the_data(views):
    class Wrong(Walk):
        def pose(self, i: int) -> torch.Tensor:
            return MOTION @ Walk().pose(i)

        true_pose = Walk.pose

    for source in (Wrong(), repaired(Wrong(), RepairConfig(depth_factor=2.0))):
        truth = ground_truth_poses(
            localiser("given", {0: MOTION}).trajectory.frame_indices,
            dataclasses.replace(views.mapping, source=source),
        )
        assert truth is not None
        assert torch.equal(truth[0], Walk().pose(0))


def test_only_poses_that_moved_have_a_trajectory_error(views):
    found = localiser(
        "given",
        {i: MOTION @ Walk().pose(i) for i in (0, 1, 3, 5)},
    )
    found.trajectory.given_poses = list(found.trajectory.poses)
    run = object.__new__(MappingRun)
    run.mapper = SimpleNamespace(localiser=found, trajectory=found.trajectory, n_frames=0)
    run.sequence = views
    run.steps = []
    assert score_trajectory(run) == {}
    found.trajectory.refine(
        2,
        MOTION @ Walk().pose(3) @ se3.exp(torch.tensor([0.0, 0.04, 0.0, 0.0, 0.0, 0.0])),
    )
    assert score_trajectory(run)["ate_mean_m"] == pytest.approx(0.01, abs=0.008)


def test_a_recording_without_poses_is_tracked_from_the_identity(tmp_path):
    sequence = open_sequence(
        "room", data=DataConfig(width=160, height=120, hold_out_every=0), n_frames=480
    )
    frames = [sequence[i] for i in range(8)]
    write_recording(tmp_path / "scan", frames)
    with pytest.raises(SequenceNotFoundError, match=r"lacks poses.txt.*--reader poses=false"):
        open_sequence(tmp_path / "scan", format="folder")
    config = gsfusion(
        "online", tracking__poses="tracked", data__hold_out_every=4, data__hold_out_offset=2
    )
    with pytest.raises(SequenceError, match="has no poses"):
        run_mapping(tmp_path / "scan", gsfusion("online"), folder=tmp_path / "no", poses=False)
    done = run_mapping(tmp_path / "scan", config, folder=tmp_path / "run", poses=False)
    assert done.metrics["n_frames"] == 6
    assert "ate_rmse_m" not in done.metrics
    assert done.metrics["psnr_mapped_db"] > 18
    assert any(
        "has no poses: each held-out frame is scored" in warning for warning in done.run.warnings
    )
    assert done.metrics["n_views_held_out"] == 2
    assert done.metrics["psnr_held_out_db"] > 18
    start = frames[0].T_WC.inverse()
    truth = [start @ f.T_WC for i, f in enumerate(frames) if i % 4 != 2]
    for pose, true in zip(done.run.poses, truth, strict=True):
        assert float((pose[:3, 3] - true[:3, 3]).norm()) < 0.02
    views = read_views(done.folder)["held_out"]
    for position, pose in zip(views.positions, views.poses, strict=True):
        turned_deg, moved_m = se3.motion(pose, start @ frames[position].T_WC)
        assert (turned_deg, moved_m) == (pytest.approx(0, abs=0.3), pytest.approx(0, abs=0.01))
    assert {view.name for view in report_views(done.run) if view.held_out} == {"Frame 2", "Frame 6"}
    before = done.metrics["psnr_held_out_db"]
    assert rescore(done.folder)["psnr_held_out_db"] == before


def test_a_held_out_frame_that_is_nowhere_in_the_map_is_not_scored(tmp_path):
    sequence = open_sequence(
        "room", data=DataConfig(width=160, height=120, hold_out_every=0), n_frames=480
    )
    frames = [sequence[i] for i in (0, 1, 2, 3, 4, 5, 240, 7)]  # frame 6 is of another place
    write_recording(tmp_path / "scan", frames)
    config = gsfusion(
        "online", tracking__poses="tracked", data__hold_out_every=4, data__hold_out_offset=2
    )
    done = run_mapping(tmp_path / "scan", config, folder=tmp_path / "run", poses=False)
    assert done.metrics["n_views_held_out"] == 1
    told = [warning for warning in done.run.warnings if "could not be found in the map" in warning]
    assert told == [
        "1 of 2 held-out frames could not be found in the map and are not scored, the first is "
        "frame 6"
    ]


def write_recording(folder, frames):
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for i, frame in enumerate(frames):
        cv2.imwrite(
            str(folder / "rgb" / f"{i:06d}.png"),
            frame.rgb_u8.numpy()[..., ::-1],
        )
        cv2.imwrite(
            str(folder / "depth" / f"{i:06d}.png"),
            (frame.depth_m * 1000).round().numpy().astype(np.uint16),
        )
    camera = vars(frames[0].camera) | {"depth_scale": 1000.0, "pixel_centre": 0.5}
    (folder / "intrinsics.json").write_text(json.dumps(camera))


DATA: dict[str, Any] = {"data__stop": 8, "data__hold_out_every": 4, "data__hold_out_offset": 2}
ROOM: dict[str, Any] = {"n_frames": 480, "width": 80, "height": 60}
SETTINGS = {
    "gsfusion": gsfusion(
        "online",
        **DATA,
        data__align_held_out=True,
        tsdf__voxel_size_m=0.04,
        tsdf__truncation_voxels=4.0,
        sh_degree=1,
        keyframe_min_seeds=20,
    ),
    "rtg_slam": rtg_slam("room", data__width=0, data__height=0, **DATA),
    "gps_slam": gps_slam(
        "room",
        data__width=0,
        data__height=0,
        **DATA,
        data__align_held_out=True,
        tsdf__voxel_size_m=0.04,
    ),
}
SCORES = ("psnr_", "ssim_", "depth_l1_", "n_views_")


def with_poses(system: str, poses: str):
    return replace(SETTINGS[system], tracking__poses=poses)


@pytest.fixture(scope="module")
def mapped_once() -> dict[tuple[str, str], tuple[Path, dict]]:
    """Folder and numbers of the runs that tests of this file share."""
    return {}


@pytest.fixture
def scored_run(mapped_once, tmp_path, tmp_path_factory):
    """``scored_run(system, poses)``: folder and numbers of a complete run; the folder is a copy for
    this test."""

    def copied(system: str, poses: str) -> tuple[Path, dict]:
        if (system, poses) not in mapped_once:
            folder = tmp_path_factory.mktemp("mapped") / "run"
            run = run_mapping("room", with_poses(system, poses), folder=folder, **ROOM)
            mapped_once[system, poses] = run.folder, run.metrics
        folder, numbers = mapped_once[system, poses]
        return shutil.copytree(folder, tmp_path / "run"), numbers

    return copied


@pytest.mark.parametrize(
    ("system", "poses"),
    [
        ("gsfusion", "given"),
        ("gsfusion", "tracked"),
        ("rtg_slam", "tracked"),
        ("gps_slam", "given"),
    ],
)
def test_scoring_again_gives_the_same_numbers(system, poses, scored_run, caplog):
    folder, _ = scored_run(system, poses)
    before = (folder / "metrics.json").read_text()
    own = {
        name: value
        for name, value in json.loads(before)["metrics"].items()
        if name.startswith(SCORES)
    }
    assert own["n_views_held_out"] == 2
    assert own["n_views_mapped"] == 6
    aligned = system != "rtg_slam"
    assert own.get("n_views_held_out_aligned", 0) == (2 if aligned else 0)
    assert not aligned or own["psnr_held_out_aligned_db"] >= own["psnr_held_out_db"]
    assert own.get("n_views_held_out_fitted", 0) == (2 if aligned else 0)
    assert not aligned or own["psnr_held_out_fitted_db"] >= own["psnr_held_out_aligned_db"] - 0.05
    again = rescore(folder)
    assert {name: again[name] for name in own} == own
    assert (folder / "metrics.json").read_text() == before
    # that kernels compile
    assert [r.getMessage() for r in caplog.records if not r.name.endswith(".announce")] == []
    assert not list(folder.glob("metrics-*"))


def test_views_between_fitted_exposures_are_shown_with_theirs_and_scored_again_alike(tmp_path):
    config = replace(
        SETTINGS["gsfusion"], keyframe_every=1, optim__fit_exposure=True, data__align_held_out=False
    )
    config = replace(config, optim__global_iterations=3)
    reader = {**ROOM, "exposure_stops": 1.0}
    run = run_mapping("room", config, folder=tmp_path / "run", **reader)
    assert run.metrics["n_views_held_out_between"] == 2
    assert run.metrics["psnr_held_out_between_db"] > run.metrics["psnr_held_out_db"] + 1
    own = {name: value for name, value in run.metrics.items() if name.startswith(SCORES)}
    again = rescore(run.folder)
    assert {name: again[name] for name in own} == own
    path = run.folder / "views.json"
    path.write_text(path.read_text().replace('"gain": [', '"gain": [1.0, '))
    with pytest.raises(ValueError, match=r"views.json is damaged: gain of frame \d+ must"):
        rescore(run.folder)


@pytest.mark.parametrize(
    ("scored", "n"),
    [(0, 6), (3, 3), (1, 1)],
)
def test_as_many_mapped_views_are_scored_as_the_settings_say(scored, n, tmp_path):
    config = replace(SETTINGS["gsfusion"], data__scored_views=scored)
    run = run_mapping("room", config, folder=tmp_path / "run", **ROOM)
    assert run.metrics["n_views_mapped"] == n
    assert json.loads((run.folder / "config.json").read_text())["fidelity"].startswith("measured")


def test_a_run_that_was_not_scored_gets_its_numbers_later(scored_run, tmp_path):
    _, scored = scored_run("gsfusion", "tracked")
    plain = run_mapping(
        "room", with_poses("gsfusion", "tracked"), folder=tmp_path / "plain", evaluate=False, **ROOM
    )
    assert "psnr_mapped_db" not in plain.metrics
    later = rescore(plain.folder)
    for name in ("psnr_mapped_db", "psnr_held_out_db", "depth_l1_held_out_m"):
        assert later[name] == scored[name]


def test_numbers_that_differ_are_named(scored_run, caplog):
    folder, _ = scored_run("gsfusion", "given")
    path = folder / "metrics.json"
    document = json.loads(path.read_text())
    true = document["metrics"]["psnr_mapped_db"]
    document["metrics"] |= {"psnr_mapped_db": 99.0, "lpips_mapped": 0.25}
    path.write_text(json.dumps(document))
    again = rescore(folder)
    assert again["psnr_mapped_db"] == true
    assert again["lpips_mapped"] == 0.25  # not asked for now, so what is there stays
    sentence = f"these scores differ from those of the run: psnr_mapped_db 99 -> {true:.6g}"
    assert sentence in caplog.text
    assert sentence in json.loads(path.read_text())["warnings"][-1]


def test_a_run_without_its_views_is_refused(scored_run):
    folder, _ = scored_run("gsfusion", "given")
    (folder / "views.json").unlink()
    with pytest.raises(
        FileNotFoundError, match=r"views.json does not exist, so the views to score"
    ):
        rescore(folder)
    (folder / "views.json").write_text('{"mapped": [{"frame": 0}]}')
    with pytest.raises(ValueError, match=r"views.json is damaged: KeyError 'T_WC'"):
        rescore(folder)


def test_other_data_than_the_run_s_are_named(scored_run, caplog):
    folder, _ = scored_run("gsfusion", "given")
    path = folder / "config.json"
    settings = json.loads(path.read_text())
    assert len(settings["data_content"]) == 32
    settings["source"]["n_frames"] = 240
    path.write_text(json.dumps(settings))
    for _ in range(2):
        rescore(folder)
    sentence = "room does not hold the data that this run was mapped from"
    assert sentence in caplog.text
    warnings = json.loads((folder / "metrics.json").read_text())["warnings"]
    assert sum(sentence in warning for warning in warnings) == 1
