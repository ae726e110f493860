"""Streams that go wrong while poses are tracked: said, survived, or ended with everything mapped so
far kept."""

import contextlib
import dataclasses
import json
import signal
import threading

import pytest
import torch

from gsfusion_nb.cli.result import print_result
from gsfusion_nb.config import DataConfig, gps_slam, gsfusion, replace, rtg_slam
from gsfusion_nb.data import BadFrameError, SequenceError, open_sequence
from gsfusion_nb.data.stream import LiveSource
from gsfusion_nb.export import read_gaussian_ply, read_trajectory_tum
from gsfusion_nb.mapping import GSFusion, make_mapper
from gsfusion_nb.runs import MappingRun, StreamRun, map_stream, run_mapping
from gsfusion_nb.runs.stream_run import KeptFrames
from gsfusion_nb.types import Frame


@pytest.fixture(scope="module")
def frames(small_room):
    """The first frames of the walk."""
    return [small_room[i] for i in range(16)]


class Source(LiveSource):
    """Gives what is listed: frames, and errors, which are raised."""

    name = "source"
    has_poses = True

    def __init__(self, items, broke_off=""):
        self.items = iter(items)
        self.loss = broke_off
        self.stopped = threading.Event()

    def __iter__(self) -> "Source":
        return self

    def __next__(self) -> Frame:
        item = next(self.items, None)
        if item is None:
            self.broke_off = self.loss
            raise StopIteration
        if isinstance(item, BaseException):
            raise item
        return item

    def stop(self):
        self.stopped.set()


class Plain:
    """A sequence without a true surface to compare the mesh with."""

    def __init__(self, source):
        self.source = source
        self.name = "plain"
        self.camera = source.camera

    def __len__(self):
        return len(self.source)

    def __getitem__(self, i):
        return self.source[i]

    def pose(self, i):
        return self.source.pose(i)


def saved(folder) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def test_a_stream_gives_the_same_maps_as_the_sequence(tmp_path, small_room, config, run_files):
    stream = map_stream(Plain(small_room), make_mapper(config), folder=tmp_path / "stream")
    whole = run_mapping(Plain(small_room), config, folder=tmp_path / "whole")
    ours = stream.mapper.gaussians.params
    theirs = whole.mapper.gaussians.params
    for name in ("xyz_W", "sh", "opacity_logit"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name))
    assert {p.name for p in stream.folder.iterdir()} == run_files
    names = (
        "psnr_held_out_db",
        "psnr_mapped_db",
        "ssim_held_out_online",
        "n_frames",
        "n_views_held_out",
    )
    for name in names:
        assert stream.metrics[name] == pytest.approx(whole.metrics[name], abs=1e-6)
    assert stream.run.timestamps_s == whole.run.timestamps_s
    document = saved(stream.folder)
    assert document["status"] == "complete"
    assert document["metrics"]["n_frames_received"] == 12
    assert document["metrics"]["n_frames_dropped"] == 0
    assert [row["frame_index"] for row in document["frames"]] == [0, 1, 3, 4, 5, 7, 8, 9, 11]


def test_anything_iterable_can_be_mapped(tmp_path, frames, config):
    run = map_stream(
        (f for f in frames), make_mapper(config), folder=tmp_path / "out", evaluate=False
    )
    assert run.metrics["n_frames"] == 9
    assert run.run.sequence.name == "stream"
    assert len(read_trajectory_tum(run.folder / "trajectory.txt")[0]) == 9


def test_a_mapper_goes_on_with_its_maps(tmp_path, frames, config):
    mapper = make_mapper(replace(config, data__hold_out_every=0, data__stop=0))
    map_stream(frames[:4], mapper, folder=tmp_path / "a", evaluate=False)
    n = len(mapper.gaussians)
    run = map_stream(frames[4:8], mapper, folder=tmp_path / "b")
    assert len(mapper.gaussians) > n
    assert mapper.trajectory.frame_indices == list(range(8))
    assert len(run.run.poses) == run.metrics["n_frames"] == 4
    assert len(read_trajectory_tum(run.folder / "trajectory.txt")[0]) == 4
    assert run.metrics["psnr_mapped_db"] > 15
    assert run.run.global_passes.losses


def test_unusable_frames_are_named_and_counted(tmp_path, frames, config):
    black = dataclasses.replace(frames[3], rgb=torch.zeros_like(frames[3].rgb))
    items = [
        frames[0],
        BadFrameError("depth/000001.png is truncated"),
        frames[2],
        black,
        *frames[4:10],
    ]
    run = map_stream(Source(items), make_mapper(config), policy="all", folder=tmp_path / "out")
    assert run.run.warnings[0] == "skipped a frame: depth/000001.png is truncated"
    assert "black" in run.run.warnings[1]
    assert run.metrics["n_frames_unusable"] == 2
    assert run.run.status == "complete"
    assert saved(run.folder)["warnings"] == run.run.warnings


def test_a_source_that_breaks_off_ends_it_with_everything_saved(
    tmp_path, frames, config, run_files
):
    source = Source(frames[:6], broke_off="the camera was disconnected: cable")
    run = map_stream(source, make_mapper(config), folder=tmp_path / "out")
    assert run.run.status == "stopped"
    assert run.run.warnings == [
        "the camera was disconnected: cable; everything mapped before is kept"
    ]
    assert {p.name for p in run.folder.iterdir()} == run_files
    assert source.stopped.is_set()


def test_an_exception_of_the_source_is_raised_after_saving(tmp_path, frames, config):
    with pytest.raises(RuntimeError, match="the driver crashed") as e:
        map_stream(
            Source([*frames[:6], RuntimeError("the driver crashed")]),
            make_mapper(config),
            folder=tmp_path / "out",
        )
    assert "frames mapped before are saved in" in e.value.__notes__[0]
    assert len(read_gaussian_ply(tmp_path / "out" / "gaussians.ply")) > 0
    assert saved(tmp_path / "out")["status"] == "failed"


def test_a_stream_without_a_usable_frame_says_why(tmp_path, frames, config):
    with pytest.raises(SequenceError, match="no frame came from source"):
        map_stream(Source([]), make_mapper(config), folder=tmp_path / "a")
    with pytest.raises(
        SequenceError, match=r"no frame of source could be mapped, the first because it is torn"
    ):
        map_stream(
            Source([BadFrameError("it is torn")]), make_mapper(config), folder=tmp_path / "b"
        )


def step_then(monkeypatch, after):
    """Call ``after(frame)`` when a frame was mapped, before the next is asked for."""
    step = GSFusion.step

    def stepping(self, frame):
        report = step(self, frame)
        after(frame)
        return report

    monkeypatch.setattr(GSFusion, "step", stepping)


class Waiting(Source):
    """Presses Ctrl-C when its frames have been mapped, then waits as a silent camera does."""

    all_mapped = threading.Event()

    def __next__(self) -> Frame:
        item = next(self.items, None)
        if item is not None:
            return item
        assert self.all_mapped.wait(20)
        signal.raise_signal(signal.SIGINT)
        assert self.stopped.wait(20)
        raise StopIteration


@pytest.mark.parametrize("on_stop", ["save", "finish"])
def test_ctrl_c_while_no_frame_comes(tmp_path, frames, config, monkeypatch, on_stop, run_files):
    source = Waiting(frames[:6])
    source.all_mapped = threading.Event()
    step_then(monkeypatch, lambda frame: source.all_mapped.set() if frame.index == 5 else None)
    run = map_stream(
        source, make_mapper(config), policy="all", folder=tmp_path / "out", on_stop=on_stop
    )
    # a stream cannot be resumed: no checkpoint
    assert {p.name for p in run.folder.iterdir()} == run_files
    if on_stop == "save":
        assert run.run.status == "interrupted"
        assert not run.run.global_passes.losses
        assert "interrupted after 5 frames" in run.run.warnings[-1]
    else:
        assert run.run.status == "complete"
        assert len(run.run.global_passes.losses) == 2
        assert run.run.warnings == ["the stream was ended by hand after 5 frames"]


@pytest.mark.parametrize(
    ("policy", "mapped", "dropped"),
    [("latest", [0, 7], 6), ("all", [0, 1, 2, 3, 4, 5, 6, 7], 0)],
)
def test_what_happens_to_frames_that_come_while_the_first_is_mapped(
    tmp_path, frames, config, monkeypatch, policy, mapped, dropped
):
    """Seven frames come at once while frame 0 is being mapped, and none later: no clock is
    involved."""
    mapping = threading.Event()
    given = threading.Event()

    def source():
        yield frames[0]
        mapping.wait(20)
        yield from frames[1:8]
        given.set()

    def after(frame):
        mapping.set()
        if policy != "all":  # there the source waits for the mapper
            given.wait(20)

    step_then(monkeypatch, after)
    every = replace(config, data__hold_out_every=0)
    run = map_stream(
        source(), make_mapper(every), policy=policy, folder=tmp_path / "out", evaluate=False
    )
    assert [s.frame_index for s in run.run.steps] == mapped
    assert run.metrics["n_frames_received"] == 8
    assert run.metrics["n_frames_dropped"] == dropped
    assert saved(run.folder)["metrics"]["n_frames_dropped"] == dropped
    assert run.metrics["policy"] == policy


def test_without_poses_the_settings_must_ask_to_track(frames, config):
    source = Source(frames)
    source.has_poses = False
    with pytest.raises(
        SequenceError, match=r"source has no poses; set tracking\.poses = 'tracked'"
    ):
        StreamRun(source, make_mapper(config))


@pytest.mark.parametrize("has_poses", [True, False])
def test_a_tracked_stream(tmp_path, config, has_poses):
    from gsfusion_nb.data.room import room

    walk = room(n_frames=960, width=112, height=84)
    source = Source(walk[i] for i in range(14))
    source.has_poses = has_poses
    tracked = replace(config, tracking__poses="tracked", tsdf__voxel_size_m=0.03)
    run = map_stream(source, make_mapper(tracked), policy="all", folder=tmp_path / "out")
    _, poses = read_trajectory_tum(run.folder / "trajectory.txt")
    truth = torch.stack([walk.pose(i) for i in run.mapper.trajectory.frame_indices]).double()
    assert (poses[:, :3, 3] - truth[:, :3, 3]).norm(dim=1).max() < 0.02
    if has_poses:
        assert run.metrics["n_views_held_out"] == 3
        assert run.metrics["ate_rmse_m"] < 0.02
    else:
        assert run.metrics["n_frames"] == 12  # none is held out
        assert "ate_rmse_m" not in run.metrics
    assert run.metrics["psnr_mapped_db"] > 15


def test_a_notebook_can_drive_it(frames, config):
    run = StreamRun(frames, make_mapper(config))
    with contextlib.closing(run.online()) as reports:
        assert [next(reports).frame_index for _ in range(3)] == [0, 1, 3]
    assert run.sequence.mapping[run.next_position - 1].index == 3
    assert run.sequence.camera == frames[0].camera
    assert "frames" not in {t.name for t in threading.enumerate()}


def test_few_frames_are_kept_evenly_spread_and_all_poses(frames):
    kept = KeptFrames("long", most=4)
    for i in range(100):
        T_WC = frames[0].T_WC.clone()
        T_WC[0, 3] = i
        frame = dataclasses.replace(frames[0], index=i, T_WC=T_WC)
        (kept.hold_out if i % 10 == 5 else kept.add)(frame)
    assert [f.index for f in kept.kept_mapped.items] == [0, 36, 71]
    assert [f.index for f in kept.kept_held_out.items] == [5, 45, 85]
    assert kept.sample(0).positions == [0, 36, 71]
    assert kept.sample(2).positions == [0, 71]
    assert kept.sample(1).positions == [0]
    assert kept.covering(50).positions == [0, 36, 71]
    assert kept[99].index == 99
    with pytest.raises(BadFrameError, match="frame 1 of long was not kept"):
        kept[1]
    assert float(kept.pose(62)[0, 3]) == 62
    assert float(kept.pose(45)[0, 3]) == 45
    opened = kept.opened()
    assert len(opened.mapping) == 90
    assert [f.index for f in opened.held_out] == [5, 45, 85]


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
    return rtg_slam(
        "room",
        data=vars(DATA),
        tracking__poses="tracked",
        window__iterations=8,
        keyframes__iterations=4,
    )


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
    indices = run.mapper.trajectory.frame_indices
    return [
        float((p[:3, 3] - truth[i][:3, 3]).norm()) for i, p in zip(indices, run.poses, strict=True)
    ]


def without_depth(frame):
    return dataclasses.replace(frame, depth_m=torch.zeros_like(frame.depth_m))


def black(frame):
    return dataclasses.replace(frame, rgb=torch.zeros_like(frame.rgb))


@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam", "gps_slam"])
def test_frames_that_cannot_be_used_are_named_and_the_path_goes_on(room, system):
    frames = [
        *room[:8],
        without_depth(room[8]),
        black(room[9]),
        BadFrameError("frame 10 is torn"),
        *room[11:20],
    ]
    run = mapped(frames, system)
    assert run.mapper.trajectory.frame_indices == [0, 1, 2, 3, 4, 5, 6, 7, *range(11, 20)]
    assert len(run.warnings) >= 3
    assert "depth" in run.warnings[0]
    assert "black" in run.warnings[1]
    assert "torn" in run.warnings[2]
    assert max(errors_m(run, frames)) < 0.02


@pytest.mark.parametrize(
    "system",
    [
        "gsfusion",
        pytest.param("rtg_slam", marks=pytest.mark.ci),
        pytest.param("gps_slam", marks=pytest.mark.ci),
    ],
)
def test_a_jump_loses_the_camera_until_it_returns(room, system):
    away = [room[-10 + i % 6] for i in range(24)]  # another corner of the room, never mapped
    frames = room[:14] + away + room[10:20]
    run = mapped(frames, system)
    lost = set(range(14, 38)) - set(run.mapper.trajectory.frame_indices)
    assert len(lost) >= 23
    assert any("cannot be tracked" in w for w in run.warnings)
    assert sum("skipped a frame" in w for w in run.warnings) == 20
    back = [i for i in run.mapper.trajectory.frame_indices if i >= 38]
    assert len(back) >= 8
    assert max(errors_m(run, frames)) < 0.03


@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam", "gps_slam"])
def test_lost_for_good_ends_with_everything_saved(room, system, tmp_path):
    frames = room[:10] + [room[-10 + i] for i in range(9)]
    done = run_mapping(Stream(frames), config(system), folder=tmp_path / "run", evaluate=False)
    assert done.run.status == "complete"
    assert print_result(done) == 3
    assert done.metrics["n_frames"] == 10
    for name in ("gaussians.ply", "trajectory.txt", "metrics.json"):
        assert (tmp_path / "run" / name).stat().st_size > 0
    assert len((tmp_path / "run" / "trajectory.txt").read_text().strip().splitlines()) >= 10
