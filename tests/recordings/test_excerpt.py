"""Parts of recordings."""

import json

import numpy as np
import pytest
import torch

from gsfusion_nb.cli import main
from gsfusion_nb.data import open_sequence
from gsfusion_nb.data.adjust.repair import as_read
from gsfusion_nb.data.recorded.recorded_sequence import RecordedSequence
from gsfusion_nb.recordings.excerpt import write_excerpt

EVERY_THIRD = slice(1, 11, 3)


def same_files(source, out, files):
    return all((out / f.relative_to(source)).read_bytes() == f.read_bytes() for f in files)


def as_stored(folder):
    """The recording, without the poses of its depth images."""
    source = as_read(open_sequence(folder).source)
    assert isinstance(source, RecordedSequence)
    return source


@pytest.mark.parametrize("name", ["redkitchen_mini48", "rgbd_dataset_freiburg1_xyz_excerpt"])
def test_images_are_kept_bit_for_bit_with_their_poses(shared_sequence, tmp_path, name):
    source = shared_sequence(name)
    whole = as_stored(source)
    assert write_excerpt(source, tmp_path / name, EVERY_THIRD) == 4
    part = as_stored(tmp_path / name)
    assert torch.equal(part.poses, whole.poses[EVERY_THIRD])
    assert part.timestamps_s == whole.timestamps_s[EVERY_THIRD] or name == "redkitchen_mini48"
    images = [*whole.rgb_files[EVERY_THIRD], *whole.depth_files[EVERY_THIRD]]
    assert same_files(source, tmp_path / name, images)
    assert (
        sum(1 for _ in (tmp_path / name).rglob("*.png"))
        + sum(1 for _ in (tmp_path / name).rglob("*.jpg"))
        == 8
    )


def test_lists_and_arrays_keep_the_chosen_frames(shared_sequence, tmp_path):
    source = tmp_path / "scan"
    mini = shared_sequence("redkitchen_mini48")
    for kind, suffix in (("rgb", "jpg"), ("depth", "png")):
        (source / f"{kind}_images").mkdir(parents=True)
        for i in range(12):
            file = next(mini.glob(f"{kind}/{i:06d}.*"))
            (source / f"{kind}_images/{i}.{suffix}").write_bytes(file.read_bytes())
    poses = np.loadtxt(mini / "poses.txt")[:12].reshape(-1, 4, 4)
    np.save(source / "poses.npy", poses)
    (source / "K.txt").write_text("265.7 0 159.0\n0 265.7 118.4\n0 0 1\n")
    assert main(["excerpt", str(source), str(tmp_path / "part"), "--frames", "1:11:3"]) == 0
    assert np.array_equal(np.load(tmp_path / "part/poses.npy"), poses[EVERY_THIRD])
    assert {p.name for p in (tmp_path / "part/rgb_images").iterdir()} == {
        "1.jpg",
        "4.jpg",
        "7.jpg",
        "10.jpg",
    }
    assert (tmp_path / "part/K.txt").read_text() == (source / "K.txt").read_text()


def test_lists_of_another_camera_and_a_recording_of_another_program(shared_sequence, tmp_path):
    write_excerpt(shared_sequence("realsense_desk_excerpt"), tmp_path / "desk", slice(3, 6))
    assert len((tmp_path / "desk/associations.txt").read_text().splitlines()) == 3
    pytest.importorskip("OpenEXR")
    source = shared_sequence("record3d_door_excerpt")
    write_excerpt(source, tmp_path / "door", slice(None, None, 20))
    assert {p.name for p in (tmp_path / "door/depth").iterdir()} == {"0.exr", "20.exr"}
    assert json.loads((tmp_path / "door/metadata.json").read_text()) == json.loads(
        (source / "metadata.json").read_text()
    )


@pytest.mark.parametrize(
    ("frames", "said"), [("5", "must be A:B"), ("100:", "has 48 frames; --frames chooses none")]
)
def test_frames_that_are_not_there(shared_sequence, tmp_path, capsys, frames, said):
    source = str(shared_sequence("redkitchen_mini48"))
    assert main(["excerpt", source, str(tmp_path / "out"), "--frames", frames]) == 1
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
