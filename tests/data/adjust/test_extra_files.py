"""Further images of frames from files."""

import shutil

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from gsfusion_nb.config import DataConfig
from gsfusion_nb.data import open_sequence, sequence_fingerprint
from gsfusion_nb.data.adjust.extra_files import ExtraSample, read_extra
from gsfusion_nb.errors import BadFrameError


@pytest.fixture(name="scene")
def copied_scene(scene, tmp_path):
    """A copy of the small scene, to which files are added."""
    return shutil.copytree(scene, tmp_path / "wall")


@pytest.fixture
def labels(scene):
    """A number for each frame of the small scene, in ``labels/INDEX.png``."""
    sequence = open_sequence(scene)
    folder = scene / "labels"
    folder.mkdir(exist_ok=True)
    for i in range(len(sequence)):
        image = np.full((sequence.camera.height, sequence.camera.width), i, dtype=np.uint16)
        cv2.imwrite(str(folder / f"{i:03d}.png"), image)
    return {"class": "labels/{index:03d}.png"}


def test_each_frame_has_its_file_and_is_resized_with_it(scene, labels):
    sequence = open_sequence(scene, extra=labels, data=DataConfig(width=8, height=6))
    for frame in sequence.mapping:
        image = frame.extra["class"]
        assert image.shape == (6, 8)
        assert image.dtype == torch.int32
        assert (image == frame.index).all()
    by_name = open_sequence(scene, extra={"picture": "rgb/{stem}.png"}).mapping[2]
    assert torch.equal(by_name.extra["picture"], by_name.rgb_u8)


def test_the_fingerprint_is_of_these_files_too(scene, labels):
    without = sequence_fingerprint(open_sequence(scene))
    first = sequence_fingerprint(open_sequence(scene, extra=labels))
    sequence = open_sequence(scene)
    ones = np.ones((sequence.camera.height, sequence.camera.width), dtype=np.uint16)
    cv2.imwrite(str(scene / "labels/002.png"), ones)
    second = sequence_fingerprint(open_sequence(scene, extra=labels))
    assert len({without, first, second}) == 3


def test_a_missing_or_damaged_file_is_a_bad_frame(scene, labels):
    (scene / "labels/001.png").unlink()
    (scene / "labels/002.png").write_bytes(b"no image")
    sequence = open_sequence(scene, extra=labels)
    assert (sequence[0].extra["class"] == 0).all()
    with pytest.raises(BadFrameError, match=r"001\.png does not exist; expected the further image"):
        sequence[1]
    with pytest.raises(BadFrameError, match=r"002\.png cannot be decoded"):
        sequence[2]


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"class": "labels/0.png"}, r"must name a file of each frame, with \{index\} or \{stem\}"),
        ({"class": "labels/{number}.png"}, "must name a file of each frame"),
        ({"class": "labels/{index.real}.png"}, "must name a file of each frame"),
        ({"class": "labels/{index:zz}.png"}, "must name a file of each frame"),
        ({"class": "masks/{stem}.png"}, "does not exist; expected the image 'class' of the first"),
    ],
)
def test_wrong_patterns_are_named(scene, extra, message):
    with pytest.raises(ValueError, match=message):
        open_sequence(scene, extra=extra)


def test_the_room_has_no_files():
    with pytest.raises(ValueError, match="need a recording in a folder, not room"):
        open_sequence("room", n_frames=2, width=8, height=6, extra={"class": "{index}.png"})


def test_labels_are_read_as_they_are_stored(tmp_path):
    numbers = np.arange(12, dtype=np.uint8).reshape(3, 4)
    palette = Image.fromarray(numbers, mode="P")
    palette.putpalette([7] * 768)
    palette.save(tmp_path / "palette.png")
    assert np.array_equal(read_extra(tmp_path / "palette.png"), numbers)
    red = np.zeros((3, 4, 3), dtype=np.uint8)
    red[..., 0] = 9
    Image.fromarray(red).save(tmp_path / "red.png")
    assert np.array_equal(read_extra(tmp_path / "red.png"), red)
    np.save(tmp_path / "features.npy", np.ones((3, 4, 5), dtype=np.float32))
    assert read_extra(tmp_path / "features.npy").shape == (3, 4, 5)
    (tmp_path / "wrong.npy").write_bytes(b"no array")
    with pytest.raises(BadFrameError, match="is not an array of NumPy"):
        read_extra(tmp_path / "wrong.npy")


def test_a_sample_stands_for_frames_of_any_size(scene, labels):
    frame = open_sequence(scene).mapping[0]
    sample = ExtraSample(images={"class": np.array([[1, 2], [3, 4]])})
    image = sample(frame)["class"]
    assert image.shape == tuple(frame.depth_m.shape)
    assert (image[0, 0], image[0, -1], image[-1, 0], image[-1, -1]) == (1, 2, 3, 4)
