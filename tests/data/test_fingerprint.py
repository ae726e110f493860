"""Any change in what a run reads changes the fingerprint, also in the middle of a file and behind a
link."""

import os
import runpy
import shutil
from pathlib import Path

import pytest

from gsfusion_nb.config import DataConfig
from gsfusion_nb.data import (
    apply_options,
    data_files,
    frame_fingerprints,
    open_sequence,
    sequence_fingerprint,
)
from gsfusion_nb.data.room import room
from gsfusion_nb.files import file_hashes, hashes, noting_files

READERS = Path(__file__).parent / "readers"


@pytest.fixture
def wall(scene, tmp_path):
    """A copy of the small scene in which ``depth`` is a link to a folder elsewhere."""
    shutil.copytree(scene, tmp_path / "wall")
    (tmp_path / "wall" / "depth").rename(tmp_path / "elsewhere")
    (tmp_path / "wall" / "depth").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    return tmp_path / "wall"


def fingerprint_of(folder) -> str:
    return sequence_fingerprint(
        open_sequence(folder, data=DataConfig(stop=6, hold_out_every=3, hold_out_offset=2))
    )


def flip(path, at: int) -> None:
    """Change one byte and keep size and times."""
    before = path.stat()
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.mark.parametrize(
    "name", ["depth/000001.png", "rgb/000002.png", "poses.txt", "intrinsics.json"]
)  # frame 2 is held out
def test_one_bit_of_a_file_that_is_read(wall, name):
    before = fingerprint_of(wall)
    assert fingerprint_of(wall) == before
    at = (
        (wall / name).read_text().index(".5") + 1
        if name == "poses.txt"
        else (wall / name).stat().st_size // 2
    )
    if name == "intrinsics.json":
        (wall / name).write_text((wall / name).read_text() + "\n")
    else:
        flip(wall / name, at)
    assert fingerprint_of(wall) != before


def test_what_is_not_read_does_not_matter(wall):
    before = fingerprint_of(wall)
    flip(wall / "rgb/000006.png", 100)  # beyond data.stop
    (wall / "notes.txt").write_text("a sunny day")
    assert fingerprint_of(wall) == before
    shutil.copytree(wall, wall.parent / "moved")
    assert fingerprint_of(wall.parent / "moved") == before


@pytest.mark.parametrize("layout", ["folder", "replica", "scannetpp", "seven_scenes"])
def test_every_file_that_a_reader_opens_is_noted(tmp_path, layout, scene, box):
    """Also those beside or above the folder, such as the camera of all scenes of Replica."""
    root = scene
    if layout != "folder":
        root = tmp_path / "data/scene"
        runpy.run_path(str(READERS / f"test_{layout}.py"))["write"](root, box)
    with noting_files() as opened:
        sequence = open_sequence(root, format=layout)
        assert [frame.index for frame in sequence.mapping] != []
        list(sequence.held_out)
    assert {os.path.abspath(path) for path in opened} == data_files(sequence).keys()


def test_of_a_sequence_in_memory_every_pixel_counts():
    frames = room(n_frames=5, width=32, height=24)
    kept = [frames[i] for i in range(5)]

    class Listed:
        name = "listed"
        camera = frames.camera

        def __len__(self):
            return 5

        def __getitem__(self, i):
            return kept[i]

        def pose(self, i):
            return kept[i].T_WC

    before = sequence_fingerprint(apply_options(Listed()))
    kept[1].depth_m[7, 7] += 0.001
    assert sequence_fingerprint(apply_options(Listed())) != before


def frames_of(path, *, options=None, **data) -> set[str]:
    sequence = open_sequence(
        path,
        data=DataConfig(hold_out_every=3, hold_out_offset=2, **data),
        **(options or {}),
    )
    found = frame_fingerprints(sequence)
    assert len(found) == len(set(found))
    return set(found)


def test_frames_of_a_recording_are_known_again(wall):
    """Whatever the size, the name of the folder and the stride, also where the selected frames
    alternate."""
    whole = frames_of(wall)
    assert len(whole) == len(list((wall / "rgb").iterdir()))
    shutil.copytree(wall, wall.parent / "copy")
    assert frames_of(wall.parent / "copy", width=16, height=12) == whole
    even = frames_of(wall, stride=2)
    odd = frames_of(wall, start=1, stride=2)
    assert even & odd
    first = frames_of(wall, stop=4)
    last = frames_of(wall, start=4)
    assert first
    assert last
    assert not first & last
    assert frames_of(wall, start=3) & first


def test_frames_of_the_room_are_known_again():
    plain = frames_of("room", options={"n_frames": 60})
    changed = {
        "n_frames": 43,
        "noise": "kinect",
        "pose_error_m": 0.01,
        "exposure_stops": 0.3,
        "holes": 0.1,
    }
    assert frames_of("room", options=changed) & plain
    assert frames_of("room", options={"n_frames": 9, "rooms": 4}) & plain
    assert not frames_of("room", options={"n_frames": 60, "seed": 1}) & plain
    assert not frames_of("room", options={"n_frames": 60, "trajectory": "novel"}) & plain
    first, last = (
        frames_of("room", options={"n_frames": 480}, **part)
        for part in ({"stop": 60}, {"start": 60})
    )
    assert not first & last
    assert frames_of("room", options={"n_frames": 480}, start=59) & first


def test_of_a_sequence_in_memory_the_pictures_count():
    frames = room(n_frames=4, width=32, height=24)
    kept = [frames[i] for i in range(4)]

    class Listed:
        name = "listed"
        camera = frames.camera

        def __init__(self, order):
            self.order = order

        def __len__(self):
            return len(self.order)

        def __getitem__(self, i):
            return kept[self.order[i]]

        def pose(self, i):
            return kept[self.order[i]].T_WC

    a, b, c = (
        set(frame_fingerprints(apply_options(Listed(order)))) for order in ([0, 1], [1, 2], [2, 3])
    )
    assert [len(a & b), len(b & c), len(a & c)] == [1, 1, 0]


def test_a_file_is_hashed_once_until_it_changes(wall, monkeypatch):
    hashed = []
    plain = hashes._hash
    monkeypatch.setattr(hashes, "_hash", lambda path: hashed.append(path) or plain(path))
    file = wall / "rgb/000000.png"
    link = wall / "link.png"
    link.symlink_to(file)
    first = file_hashes([file, link])
    assert len(set(first.values())) == 1
    assert len(hashed) == 2
    file_hashes([file])
    # changed less than two seconds ago: a second change might have the same time
    assert len(hashed) == 3
    monkeypatch.setattr(hashes, "_SETTLED_NS", -(10**18))
    assert file_hashes([file]) == file_hashes([file]) == {str(file): first[str(file)]}
    assert len(hashed) == 4
    flip(file, 50)
    assert file_hashes([file, wall / "none"]).values() != first.values()
    assert len(hashed) == 5
    assert file_hashes([wall / "none", wall]) == dict.fromkeys(
        [str(wall / "none"), str(wall)], hashes.UNREADABLE
    )
