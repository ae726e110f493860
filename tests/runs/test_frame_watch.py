"""A run says in one line where its frames do not agree with each other, and of right frames it says
nothing."""

import dataclasses
import json
import logging

import pytest
import torch
from box_room import Box
from frame_faults import FAULTS, repeats

from gsfusion_nb.config import replace
from gsfusion_nb.data import folder
from gsfusion_nb.data.room import room
from gsfusion_nb.geometry import se3
from gsfusion_nb.runs import frame_watch, run_mapping
from gsfusion_nb.runs.frame_watch import ADVICE, FrameWatch
from gsfusion_nb.runs.quiet_watch import QuietWatch

N_FRAMES = 14


def walk(n_frames=200, **options):
    """The first frames of a walk through the room."""
    sequence = room(n_frames=n_frames, width=80, height=60, **options)
    return [sequence[i] for i in range(N_FRAMES)]


@pytest.fixture(scope="module")
def frames():
    return walk()


def said_of(frames, *, is_tracking=False, watch=None, poses=()):
    """The first sentence that a watch says of the frames."""
    watch = watch or FrameWatch(is_tracking=is_tracking)
    poses = list(poses)
    for frame in frames:
        poses.append(frame.T_WC)
        said = watch.see(frame, poses)
        if said:
            return said
    return watch.end(poses)


RIGHT = {
    "exact": {},
    "slow": {"n_frames": 1200},
    "frames far apart": {"n_frames": 40},
    "a Kinect's noise": {"noise": "kinect"},
    "slow, with a Kinect's noise": {"n_frames": 1200, "noise": "kinect"},
    "exposure": {"exposure_stops": 0.5},
    "imprecise poses": {"pose_error_m": 0.005, "pose_error_deg": 0.3},
    "late poses": {"pose_delay_s": 0.03},
    "holes": {"holes": 0.3},
    "another path": {"trajectory": "novel"},
}


@pytest.mark.parametrize("name", RIGHT)
def test_of_right_frames_nothing_is_said(name):
    assert said_of(walk(**RIGHT[name])) == ""


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_said_in_one_line(frames, fault):
    change, words = FAULTS[fault]
    said = said_of(change(frames))
    assert words in said
    assert said.endswith(ADVICE)
    assert "usual" in said
    assert "\n" not in said


@pytest.mark.parametrize(
    "fault", ["world-to-camera poses", "focal length 1.5 times too long", "shuffled depth"]
)
def test_a_short_recording_is_judged_at_its_end(frames, fault):
    assert said_of(frames[:6]) == ""
    assert said_of(FAULTS[fault][0](frames[:6])).endswith(ADVICE)
    assert said_of(FAULTS["world-to-camera poses"][0](frames[:3])) == ""


def test_a_camera_that_begins_at_rest_is_judged_when_it_moves():
    frames = walk(1200)
    still = [dataclasses.replace(frames[0], index=i) for i in range(12)]
    moving = [dataclasses.replace(f, index=12 + f.index) for f in frames[1:]]
    assert said_of([*still, *moving]) == ""
    inverted = [dataclasses.replace(f, T_WC=se3.inverse(f.T_WC)) for f in [*still, *moving]]
    assert "frames 0 to 23 agree" in said_of(inverted)


def test_pictures_without_anything_to_see_prove_nothing(frames):
    white = [dataclasses.replace(f, colour=torch.full_like(f.rgb_u8, 200)) for f in frames]
    dark = [dataclasses.replace(f, colour=f.rgb_u8 // 30) for f in frames]
    wall = [
        dataclasses.replace(
            f,
            depth_m=torch.full_like(f.depth_m, 2.0),
            T_WC=torch.eye(4),
        )
        for f in white
    ]
    for right in (white, dark, wall):
        assert said_of(right) == ""


def test_along_a_flat_wall_standing_still_is_no_better_reading(frames):
    white = torch.full_like(frames[0].rgb_u8, 200)
    wall = torch.full_like(frames[0].depth_m, 2.0)
    along = []
    for i, frame in enumerate(frames):
        T_WC = torch.eye(4)
        T_WC[0, 3] = 0.1 * i
        along.append(dataclasses.replace(frame, colour=white, depth_m=wall, T_WC=T_WC))
    assert said_of(along) == ""


def test_a_camera_that_stands_still_may_repeat_its_images(frames):
    still = [
        dataclasses.replace(
            frames[0],
            index=i,
            T_WC=frames[0].T_WC.clone(),
        )
        for i in range(N_FRAMES)
    ]
    assert said_of(still) == ""
    tracked = [dataclasses.replace(f, T_WC=frames[i].T_WC) for i, f in enumerate(still)]
    assert "has the colour and depth of frame 0" in said_of(tracked)
    assert said_of(repeats("colour", "depth_m")(frames), is_tracking=True) == ""
    assert "has the depth of frame 5" in said_of(repeats("depth_m")(frames), is_tracking=True)


def test_a_pause_and_what_the_mapper_tells_are_no_jumps(frames):
    paused = [
        dataclasses.replace(f, timestamp_s=f.timestamp_s + 60.0 * (i > 5))
        for i, f in enumerate(frames)
    ]
    assert "the pose jumps" in said_of(FAULTS["a jump of 1.7 m"][0](frames))
    assert "the pose jumps" not in said_of(FAULTS["a jump of 1.7 m"][0](paused))
    away = torch.eye(4)
    away[2, 3] = 9.0  # farther than a camera moves in a frame
    far = [dataclasses.replace(f, T_WC=away @ f.T_WC) if i > 5 else f for i, f in enumerate(frames)]
    assert "the pose jumps" not in said_of(far)


def test_a_recording_that_goes_on_at_another_place_is_right(frames):
    elsewhere = room(n_frames=200, width=80, height=60)
    assert said_of([*frames[:6], *(elsewhere[i] for i in range(30, 38))]) == ""


def test_frames_without_depth_or_of_another_camera_do_not_stop_it(frames):
    empty = dataclasses.replace(frames[3], depth_m=torch.zeros_like(frames[3].depth_m))
    assert said_of([*frames[:3], empty, *frames[4:]]) == ""
    other = room(n_frames=200, width=64, height=48)
    assert said_of([*frames[:5], *(other[i] for i in range(5, N_FRAMES))]) == ""


@pytest.mark.parametrize("n", [2, 5, 12, 13])
@pytest.mark.parametrize(
    "fault", ["world-to-camera poses", "a jump of 1.7 m", "three repeated frames"]
)
def test_after_a_checkpoint_it_goes_on_where_it_was(frames, n, fault, monkeypatch):
    # not said before
    monkeypatch.setattr(frame_watch, "BETTER", 0.5 if n >= 12 else frame_watch.BETTER)
    changed = FAULTS[fault][0](frames)
    poses = [f.T_WC for f in changed]
    earlier = FrameWatch(is_tracking=False)
    for i in range(n):
        earlier.see(changed[i], poses[: i + 1])
    again = FrameWatch(is_tracking=False)
    again.look_again(n, lambda number: changed[number], poses[:n])
    rest = [said_of(changed[n:], watch=watch, poses=poses[:n]) for watch in (earlier, again)]
    assert rest[0] == rest[1]


MISREAD = {
    "inverted poses": (se3.inverse, 1000.0),
    "OpenGL axes": (
        lambda T: T @ torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)),
        1000.0,
    ),
    "a depth scale that was 1000 instead of 5000": (lambda T: T, 200.0),
    "a depth scale that was 5000 instead of 1000": (lambda T: T, 5000.0),
}


@pytest.mark.parametrize("mistake", [None, *MISREAD])
def test_a_folder_that_means_something_else(tmp_path, mistake):
    box = Box()
    root = box.folder(
        tmp_path,
        n=14,
        depth_scale=MISREAD[mistake][1] if mistake else 1000.0,
    )
    if mistake:
        lines = [
            " ".join(map(repr, MISREAD[mistake][0](T).flatten().tolist())) for T in box.poses(14)
        ]
        (root / "poses.txt").write_text("\n".join(lines))
    assert bool(said_of(folder(root))) == (mistake is not None)


@pytest.mark.parametrize("name", ["redkitchen_mini48", "livingroom1_clean211"])
def test_real_sequences_are_consistent(shared_sequence, name):
    sequence = folder(shared_sequence(name))
    assert said_of(sequence[i] for i in range(N_FRAMES)) == ""


class Sequence:
    """Frames as a sequence."""

    name = "frames"
    has_poses = True

    def __init__(self, frames):
        self.camera = frames[0].camera
        self.frames = frames

    def __len__(self):
        return len(self.frames)

    def pose(self, i):
        return self.frames[i].T_WC

    def __getitem__(self, i):
        return self.frames[i]


@pytest.fixture(scope="module")
def wrong_run(config, frames, tmp_path_factory):
    """A run on world-to-camera poses, and what it logged."""
    settings = replace(config, data__stop=6, data__hold_out_every=0)
    wrong = Sequence(FAULTS["world-to-camera poses"][0](frames))
    logged = []
    handler = logging.Handler()
    handler.emit = lambda record: logged.append(record.getMessage())
    logging.getLogger("gsfusion_nb").addHandler(handler)
    try:
        return run_mapping(wrong, settings, folder=tmp_path_factory.mktemp("wrong") / "run"), logged
    finally:
        logging.getLogger("gsfusion_nb").removeHandler(handler)


def test_the_line_is_in_the_terminal_the_numbers_and_the_page(wrong_run):
    finished, logged = wrong_run
    (line,) = [sentence for sentence in finished.run.warnings if sentence.endswith(ADVICE)]
    assert "with inverted poses" in line
    assert logged.count(line) == 1
    assert (
        line
        in json.loads((finished.folder / "metrics.json").read_text(encoding="utf-8"))["warnings"]
    )
    assert line in (finished.folder / "report.html").read_text(encoding="utf-8")


def test_the_maps_are_those_of_a_run_that_nobody_watches(
    wrong_run, config, frames, tmp_path, monkeypatch
):
    monkeypatch.setattr(QuietWatch, "look", lambda *_: None)
    settings = replace(config, data__stop=6, data__hold_out_every=0)
    alone = run_mapping(
        Sequence(FAULTS["world-to-camera poses"][0](frames)),
        settings,
        folder=tmp_path / "run",
        evaluate=False,
    )
    assert alone.run.hashes == wrong_run[0].run.hashes
    assert not any(sentence.endswith(ADVICE) for sentence in alone.run.warnings)


def test_a_watch_that_fails_ends_no_run(config, frames, tmp_path, monkeypatch):
    def fails(*_):
        raise ZeroDivisionError("nothing")

    monkeypatch.setattr(FrameWatch, "see", fails)
    settings = replace(config, data__stop=6, data__hold_out_every=0)
    finished = run_mapping(Sequence(frames), settings, folder=tmp_path / "run", evaluate=False)
    assert finished.run.status == "complete"
    assert [s for s in finished.run.warnings if s.endswith(ADVICE)] == [
        "whether the frames agree is not watched any further (ZeroDivisionError: nothing); "
        f"{ADVICE}"
    ]
