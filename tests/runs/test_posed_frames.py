"""Frames at the poses of the map: given, tracked, and in between."""

import dataclasses
import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.config import DataConfig, RepairConfig, TrackingConfig, gsfusion
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
from gsfusion_nb.runs import MappingRun, run_mapping
from gsfusion_nb.runs.outputs import score_trajectory
from gsfusion_nb.runs.posed_frames import frames_in_map, ground_truth_poses, readable_frames
from gsfusion_nb.types import Camera, Frame

CAMERA = Camera(width=8, height=6, fx=8.0, fy=8.0, cx=4.0, cy=3.0)


class Path:
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
        return Frame(index=i, timestamp_s=0.0, rgb=picture, depth_m=torch.ones(6, 8), camera=CAMERA, T_WC=self.pose(i))


@pytest.fixture
def views():
    return apply_options(Path(), DataConfig(hold_out_every=4, hold_out_offset=2))  # 2 and 6 are held out


def localiser(poses: str, moved: dict[int, torch.Tensor]) -> Localiser:
    found = Localiser(TrackingConfig(poses=poses))  # pyright: ignore[reportArgumentType]
    found.frame_indices, found.poses = list(moved), list(moved.values())
    return found


MOTION = se3.exp(torch.tensor([0.5, -0.2, 0.1, 0.3, 0.1, -0.2]))


def test_damaged_frames_are_left_out(views):
    assert [f.index for f in readable_frames(views.mapping)] == [0, 1, 3, 4, 5, 8, 9]


def test_given_poses_stay(views):
    found = localiser("given", {0: MOTION})
    for frame in frames_in_map(views.mapping, found, views.mapping):
        assert torch.equal(frame.T_WC, Path().pose(frame.index))


def test_a_mapped_frame_has_its_tracked_pose_and_others_follow_the_nearest(views):
    """The tracked world is the data's, moved; so every frame comes out moved alike."""
    tracked = {i: MOTION @ Path().pose(i) for i in (0, 1, 3, 5, 8)}
    tracked[8] = tracked[8] @ se3.exp(torch.tensor([0.01, 0.0, 0.0, 0.0, 0.0, 0.0]))  # an error of tracking
    found = localiser("tracked", tracked)
    for frame in frames_in_map(views.mapping, found, views.mapping):
        if frame.index in tracked:
            assert torch.equal(frame.T_WC, tracked[frame.index])
    by_index = {f.index: f.T_WC for f in frames_in_map(views.held_out, found, views.mapping)}
    assert set(by_index) == {2, 6}
    for i, T_WC in by_index.items():
        torch.testing.assert_close(T_WC, MOTION @ Path().pose(i), atol=1e-5, rtol=0)
    late = {f.index: f.T_WC for f in frames_in_map(views.mapping, found, views.mapping)}
    expected = tracked[8] @ se3.inverse(Path().pose(8)) @ Path().pose(9)  # nearest is 8, with its error
    torch.testing.assert_close(late[9], expected, atol=1e-5, rtol=0)


def test_before_anything_was_tracked_the_data_count(views):
    frames = list(frames_in_map(views.mapping, localiser("tracked", {}), views.mapping))
    assert all(torch.equal(f.T_WC, Path().pose(f.index)) for f in frames)


def test_ground_truth_poses_of_the_mapped_frames(views):
    found = localiser("tracked", dict.fromkeys((0, 3, 9), MOTION))
    truth = ground_truth_poses(found, views.mapping)
    assert truth is not None
    assert torch.equal(truth, torch.stack([Path().pose(i) for i in (0, 3, 9)]))


def test_the_true_poses_count_more_than_those_of_the_data(views):
    class Wrong(Path):
        def pose(self, i: int) -> torch.Tensor:
            return MOTION @ Path().pose(i)

        true_pose = Path.pose

    for source in (Wrong(), repaired(Wrong(), RepairConfig(depth_factor=2.0))):
        truth = ground_truth_poses(localiser("given", {0: MOTION}), dataclasses.replace(views.mapping, source=source))
        assert truth is not None
        assert torch.equal(truth[0], Path().pose(0))


def test_only_poses_that_moved_have_a_trajectory_error(views):
    found = localiser("given", {i: MOTION @ Path().pose(i) for i in (0, 1, 3, 5)})
    found.given = list(found.poses)
    run = object.__new__(MappingRun)
    run.mapper, run.sequence, run.steps = SimpleNamespace(localiser=found), views, []
    assert score_trajectory(run) == {}
    found.refine(2, MOTION @ Path().pose(3) @ se3.exp(torch.tensor([0.0, 0.04, 0.0, 0.0, 0.0, 0.0])))
    assert score_trajectory(run)["ate_mean_m"] == pytest.approx(0.01, abs=0.008)


def test_no_ground_truth_where_one_is_missing(views):
    class Poseless(Path):
        def pose(self, i: int) -> torch.Tensor:
            raise BadFrameError("no pose")

    view = dataclasses.replace(views.mapping, source=Poseless())
    assert ground_truth_poses(localiser("tracked", {0: MOTION}), view) is None


def test_a_recording_without_poses_is_tracked_from_the_identity(tmp_path):
    sequence = open_sequence("room", data=DataConfig(width=160, height=120, hold_out_every=0), n_frames=480)
    frames = [sequence[i] for i in range(8)]
    write_recording(tmp_path / "scan", frames)
    with pytest.raises(SequenceNotFoundError, match=r"lacks poses.txt.*--reader poses=false"):
        open_sequence(tmp_path / "scan", format="folder")
    config = gsfusion("online", tracking__poses="tracked", data__hold_out_every=4, data__hold_out_offset=2)
    with pytest.raises(SequenceError, match="has no poses"):
        run_mapping(tmp_path / "scan", gsfusion("online"), folder=tmp_path / "no", poses=False)
    done = run_mapping(tmp_path / "scan", config, folder=tmp_path / "run", poses=False)
    assert done.metrics["n_frames"] == 6
    assert "ate_rmse_m" not in done.metrics
    assert done.metrics["n_views_held_out"] == 0
    assert done.metrics["psnr_mapped_db"] > 18
    start = frames[0].T_WC.inverse()
    truth = [start @ f.T_WC for i, f in enumerate(frames) if i % 4 != 2]
    for pose, true in zip(done.run.poses, truth, strict=True):
        assert float((pose[:3, 3] - true[:3, 3]).norm()) < 0.02


def write_recording(folder, frames):
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for i, frame in enumerate(frames):
        cv2.imwrite(str(folder / "rgb" / f"{i:06d}.png"), frame.rgb_u8.numpy()[..., ::-1])
        cv2.imwrite(str(folder / "depth" / f"{i:06d}.png"), (frame.depth_m * 1000).round().numpy().astype(np.uint16))
    camera = vars(frames[0].camera) | {"depth_scale": 1000.0, "pixel_centre": 0.5}
    (folder / "intrinsics.json").write_text(json.dumps(camera))
