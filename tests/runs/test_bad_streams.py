"""Streams that go wrong while poses are tracked: said, survived, or ended with everything mapped so far kept."""

import dataclasses

import pytest
import torch

from gsfusion_nb.cli.result import print_result
from gsfusion_nb.config import DataConfig, gps_slam, gsfusion, rtg_slam
from gsfusion_nb.data import BadFrameError, SequenceError, open_sequence
from gsfusion_nb.mapping import make_mapper
from gsfusion_nb.runs import MappingRun, mapping_run, run_mapping
from gsfusion_nb.types import Frame

DATA = DataConfig(width=112, height=84, hold_out_every=0)


class Stream:
    """Frames given as a list; an exception in it is raised when its turn comes."""

    name = "stream"

    def __init__(self, frames):
        self.frames = frames
        self.camera = next(f for f in frames if isinstance(f, Frame)).camera

    def __len__(self):
        return len(self.frames)

    def __getitem__(self, i):
        frame = self.frames[i]
        if isinstance(frame, Exception):
            raise frame
        return dataclasses.replace(frame, index=i, timestamp_s=i / 30)

    def pose(self, i):
        return self.frames[i].T_WC


@pytest.fixture(scope="module")
def room():
    sequence = open_sequence("room", data=DATA, n_frames=480)
    return [sequence[i] for i in range(200) if i < 24 or i >= 190]


def config(system):
    if system == "gsfusion":
        return gsfusion("room", data=vars(DATA), tracking__poses="tracked", tsdf__voxel_size_m=0.03)
    if system == "gps_slam":
        return gps_slam("room", data=vars(DATA), tracking__poses="tracked", tsdf__voxel_size_m=0.03)
    return rtg_slam("room", data=vars(DATA), tracking__poses="tracked", window__iterations=8, keyframes__iterations=4)


def mapped(frames, system):
    run = MappingRun(open_stream(frames), make_mapper(config(system)))
    for _ in run.online():
        pass
    return run


def open_stream(frames):
    from gsfusion_nb.data import apply_options

    return apply_options(Stream(frames), DATA)


def errors_m(run, frames):
    truth = {i: f.T_WC for i, f in enumerate(frames) if isinstance(f, Frame)}
    indices = run.mapper.localiser.frame_indices
    return [float((p[:3, 3] - truth[i][:3, 3]).norm()) for i, p in zip(indices, run.poses, strict=True)]


def without_depth(frame):
    return dataclasses.replace(frame, depth_m=torch.zeros_like(frame.depth_m))


def black(frame):
    return dataclasses.replace(frame, rgb=torch.zeros_like(frame.rgb))


@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam", "gps_slam"])
def test_frames_that_cannot_be_used_are_named_and_the_path_goes_on(room, system):
    frames = [*room[:8], without_depth(room[8]), black(room[9]), BadFrameError("frame 10 is torn"), *room[11:20]]
    run = mapped(frames, system)
    assert run.mapper.localiser.frame_indices == [0, 1, 2, 3, 4, 5, 6, 7, *range(11, 20)]
    assert len(run.warnings) >= 3
    assert "depth" in run.warnings[0]
    assert "black" in run.warnings[1]
    assert "torn" in run.warnings[2]
    assert max(errors_m(run, frames)) < 0.02


@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam", "gps_slam"])
def test_a_frozen_camera_stands_still(room, system):
    frames = room[:6] + [room[5]] * 6 + room[6:14]
    run = mapped(frames, system)
    assert len(run.poses) == len(frames)
    assert max(errors_m(run, frames)) < 0.02


@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam", "gps_slam"])
def test_a_jump_loses_the_camera_until_it_returns(room, system):
    away = [room[-10 + i] for i in range(6)]  # another corner of the room, never mapped
    frames = room[:14] + away + room[10:20]
    run = mapped(frames, system)
    lost = set(range(14, 20)) - set(run.mapper.localiser.frame_indices)
    assert len(lost) >= 5
    assert any("cannot be tracked" in w for w in run.warnings)
    back = [i for i in run.mapper.localiser.frame_indices if i >= 20]
    assert len(back) >= 8
    assert max(errors_m(run, frames)) < 0.03


@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam", "gps_slam"])
def test_lost_for_good_ends_with_everything_saved(room, system, tmp_path, monkeypatch):
    monkeypatch.setattr(mapping_run, "MAX_BAD_FRAMES_IN_A_ROW", 4)
    frames = room[:10] + [room[-10 + i] for i in range(9)]
    done = run_mapping(Stream(frames), config(system), folder=tmp_path / "run", evaluate=False)
    assert done.run.status == "stopped"
    assert print_result(done) == 3
    assert done.metrics["n_frames"] == 10
    for name in ("gaussians.ply", "trajectory.txt", "metrics.json"):
        assert (tmp_path / "run" / name).stat().st_size > 0
    assert len((tmp_path / "run" / "trajectory.txt").read_text().strip().splitlines()) >= 10


@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam", "gps_slam"])
def test_a_stream_without_any_usable_frame_says_why(room, system):
    with pytest.raises(SequenceError, match=r"none of the 3 frames could be mapped.*depth"):
        mapped([without_depth(f) for f in room[:3]], system)
