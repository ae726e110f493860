import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from gsfusion_nb.data import BadFrameError, SequenceError, SequenceNotFoundError, folder
from gsfusion_nb.data.stream import GrowingFolder
from gsfusion_nb.types import Frame


@pytest.fixture
def recorded(box, tmp_path):
    """A finished folder of six frames, to be copied piece by piece."""
    return box.folder(tmp_path / "recorded", 6)


class Writer:
    """Writes a folder step by step; each wait of the reader is one step, so that nothing depends on
    the clock."""

    def __init__(self, source: Path, target: Path):
        self.source = source
        self.target = target
        for kind in ("rgb", "depth"):
            (target / kind).mkdir(parents=True)
        self.lines = (source / "poses.txt").read_text().splitlines(keepends=True)
        self.steps = []
        self.waits = 0

    def __call__(self, _seconds):
        self.waits += 1
        for action in self.steps.pop(0) if self.steps else ():
            action()

    def then(self, *actions):
        self.steps.append(actions)
        return self

    def file(self, name: str, share: float = 1.0):
        def write():
            data = (self.source / name).read_bytes()
            (self.target / name).write_bytes(data[: round(share * len(data))])

        return write

    def camera(self):
        return self.file("intrinsics.json")

    def rgb(self, i, share=1.0):
        return self.file(f"rgb/{i:06d}.jpg", share)

    def depth(self, i, share=1.0):
        return self.file(f"depth/{i:06d}.png", share)

    def pose(self, i, part: slice = slice(None)):
        def append():
            with (self.target / "poses.txt").open("a") as file:
                file.write(self.lines[i][part])

        return append

    def whole(self, i):
        return (self.rgb(i), self.depth(i), self.pose(i))

    def stop(self):
        (self.target / "stop").touch()


@pytest.fixture
def writer(recorded, tmp_path):
    return Writer(recorded, tmp_path / "live")


def follow(writer: Writer, **options) -> GrowingFolder:
    return GrowingFolder(writer.target, wait=writer, **options)


def everything(source: GrowingFolder) -> list[Any]:
    """What comes: frames, and of errors their text."""
    found: list[Any] = []
    while True:
        try:
            found.append(next(source))
        except StopIteration:
            return found
        except BadFrameError as e:
            found.append(str(e))


def indices(found) -> list:
    return [round(f.timestamp_s * 30) if isinstance(f, Frame) else "bad" for f in found]


def test_frames_that_are_written_one_by_one_are_those_of_the_finished_folder(writer, recorded):
    writer.then(writer.camera())
    for i in range(6):
        writer.then(*writer.whole(i))
    found = everything(follow(writer))
    whole = folder(recorded)
    assert indices(found) == list(range(6))
    for i, frame in enumerate(found):
        assert isinstance(frame, Frame)
        assert frame.camera == whole.camera
        torch.testing.assert_close(frame.rgb, whole[i].rgb)
        torch.testing.assert_close(frame.depth_m, whole[i].depth_m)
        torch.testing.assert_close(frame.T_WC, whole[i].T_WC)


def test_a_frame_comes_only_when_both_images_and_the_pose_are_whole(writer):
    """In pieces: half of the colour, all of it, half of the depth, all of it, half of the pose's
    line, its end."""
    writer.then(writer.camera(), writer.rgb(0, 0.5)).then(writer.rgb(0)).then(writer.depth(0, 0.0))
    writer.then(writer.depth(0, 0.6)).then(writer.depth(0)).then().then(
        writer.pose(0, slice(0, 40))
    )
    writer.then().then(writer.pose(0, slice(40, None)))
    source = follow(writer)
    frame = next(source)
    assert writer.waits == 9
    assert not writer.steps
    assert frame.rgb.shape == (48, 64, 3)


def test_poses_that_come_late_are_waited_for(writer):
    writer.then(
        writer.camera(),
        *(writer.rgb(i) for i in range(3)),
        *(writer.depth(i) for i in range(3)),
    )
    for _ in range(50):  # 5 s, longer than an incomplete frame is waited for
        writer.then()
    writer.then(writer.pose(0), writer.pose(1)).then(writer.pose(2))
    assert indices(everything(follow(writer))) == [0, 1, 2]


def test_depth_that_never_comes_is_named_and_the_poses_stay_with_their_frames(writer, recorded):
    writer.then(
        writer.camera(),
        writer.rgb(0),
        writer.depth(0),
        writer.rgb(1),
        writer.rgb(2),
        writer.depth(2),
    )
    writer.then(*(writer.pose(i) for i in range(3)))
    found = everything(follow(writer))
    assert indices(found) == [0, "bad", 2]
    assert "depth has no image 000001" in found[1]
    torch.testing.assert_close(found[2].T_WC, folder(recorded)[2].T_WC)


def test_a_damaged_image_and_a_bad_pose_line_are_named(writer):
    writer.then(
        writer.camera(),
        *writer.whole(0),
        writer.rgb(1),
        writer.depth(1),
    )

    def damage():
        data = bytearray((writer.target / "depth/000001.png").read_bytes())
        data[60:200] = b"\0" * 140
        (writer.target / "depth/000001.png").write_bytes(data)
        with (writer.target / "poses.txt").open("a") as file:
            file.write("1 0 0\nnan " + "0 " * 15 + "\n")

    shutil.copy(writer.source / "rgb/000002.jpg", writer.target / "rgb")
    shutil.copy(writer.source / "depth/000002.png", writer.target / "depth")
    writer.then(
        damage,
        writer.rgb(3),
        writer.depth(3),
        writer.pose(3),
    )
    found = everything(follow(writer))
    assert indices(found) == [0, "bad", "bad", 3]
    assert "pose 1 must be 16 row-major numbers, got '1 0 0'" in found[1]
    assert "pose 2 has NaN" in found[2]


def check_poses(found, truth, expected: dict[int, int]) -> None:
    """``expected``: place in ``found`` -> frame of ``truth``."""
    for place, i in expected.items():
        torch.testing.assert_close(found[place].T_WC, truth[i].T_WC)
        torch.testing.assert_close(found[place].depth_m, truth[i].depth_m)


def test_a_missing_image_does_not_shift_the_poses(writer, recorded):
    writer.then(
        writer.camera(),
        *(write for i in (0, 1, 3, 5) for write in (writer.rgb(i), writer.depth(i))),
    )
    writer.then(*(writer.pose(i) for i in range(6)))
    found = everything(follow(writer))
    assert indices(found) == [0, 1, 3, 5]
    check_poses(
        found,
        folder(recorded),
        {0: 0, 1: 1, 2: 3, 3: 5},
    )


def test_lines_may_begin_with_the_name_of_their_image(writer, recorded):
    writer.lines = [f"{i:06d}.jpg {line}" for i, line in enumerate(writer.lines)]
    writer.then(
        writer.camera(),
        *(write for i in (1, 2, 4) for write in (writer.rgb(i), writer.depth(i))),
    )
    writer.then(*(writer.pose(i) for i in (3, 4, 0, 2, 1)))
    check_poses(
        everything(follow(writer)),
        folder(recorded),
        {0: 1, 1: 2, 2: 4},
    )


def test_images_that_do_not_begin_at_0_need_to_say_whose_the_first_line_is(writer):
    """A first image 1 may be the first of all, or 0 may be missing."""
    writer.then(
        writer.camera(),
        *writer.whole(0)[2:],
        *writer.whole(1),
        *writer.whole(2),
    )
    with pytest.raises(
        SequenceError, match=r"not clear which line of .*poses.txt belongs to .*000001.jpg"
    ):
        everything(follow(writer))


def test_the_stop_file_ends_it_after_the_frames_that_are_there(writer):
    writer.then(
        writer.camera(),
        *writer.whole(0),
        *writer.whole(1)[:2],
        writer.pose(1, slice(0, -1)),
        writer.stop,
    )
    source = follow(writer)
    assert indices(everything(source)) == [
        0,
        1,
    ]  # the last line has no end, but nothing will be added
    assert writer.waits == 1


def test_what_comes_after_later_frames_is_left_out_and_named(writer):
    """The images of frames 1 and 2 arrive together with those of frame 4, when frame 3 was
    taken."""
    parts = {i: (writer.rgb(i), writer.depth(i)) for i in range(5)}
    writer.then(writer.camera(), *parts[0], *parts[3]).then(*parts[1], *parts[2], *parts[4]).then(
        writer.stop
    )
    whole = folder(writer.source)
    found = everything(follow(writer, poses=False))
    assert ["000001" in found[2], "000002" in found[3]] == [True, True]
    assert all("came after later frames were taken" in text for text in found[2:4])
    for frame, i in ((found[0], 0), (found[1], 3), (found[4], 4)):
        torch.testing.assert_close(frame.depth_m, whole[i].depth_m)
    assert len(found) == 5


def test_hidden_files_are_no_frames(writer):
    """As programs that copy or edit leave them for a while."""
    (writer.target / "rgb/.000000.jpg").write_bytes((writer.source / "rgb/000003.jpg").read_bytes())
    (writer.target / "depth/.000000.png").write_bytes(
        (writer.source / "depth/000003.png").read_bytes()
    )
    writer.then(
        writer.camera(),
        writer.rgb(1),
        writer.depth(1),
        writer.stop,
    )
    [frame] = everything(follow(writer, poses=False))
    torch.testing.assert_close(frame.depth_m, folder(writer.source)[1].depth_m)


def test_without_poses_the_camera_is_to_be_tracked(writer):
    writer.then(
        writer.camera(),
        writer.rgb(0),
        writer.depth(0),
        writer.stop,
    )
    source = follow(writer, poses=False)
    assert not source.has_poses
    [frame] = everything(source)
    assert isinstance(frame, Frame)
    torch.testing.assert_close(frame.T_WC, torch.eye(4))


def test_a_folder_without_intrinsics_says_so_in_the_end(writer):
    writer.then(
        writer.rgb(0),
        writer.depth(0),
        writer.pose(0),
    )
    with pytest.raises(SequenceNotFoundError, match=r"intrinsics\.json does not exist"):
        everything(follow(writer, idle_s=1))
    (writer.target / "intrinsics.json").write_text('{"width": 64')
    with pytest.raises(SequenceError, match=r"intrinsics\.json is not valid JSON"):
        everything(follow(writer, idle_s=1))
