"""Values that are no camera, time, size or text of a recording: each is refused, or said, by name."""

import json
import logging
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.data import open_sequence
from gsfusion_nb.data.recorded.images import is_to_be_turned
from gsfusion_nb.data.stream.growing_folder import GrowingFolder
from gsfusion_nb.export.gaussian_files import read_gaussians
from gsfusion_nb.files import BadFrameError, SequenceError, SequenceNotFoundError, plain_cell
from gsfusion_nb.recordings.convert.formats.colmap import read_model


@pytest.fixture
def plain(tmp_path):
    """``plain(width, height, **intrinsics)``: a folder of three frames in the plain layout."""

    def write(width: int = 32, height: int = 24, suffix: str = ".png", **more) -> Path:
        for kind in ("rgb", "depth"):
            (tmp_path / kind).mkdir()
        for i in range(3):
            colour = np.full((height, width, 3), 60 * i, np.uint8)
            assert cv2.imwrite(str(tmp_path / f"rgb/{i}{suffix}"), colour)
            assert cv2.imwrite(str(tmp_path / f"depth/{i}.png"), np.full((height, width), 2000, np.uint16))
        (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n" * 3)
        camera = {"width": width, "height": height, "fx": width, "fy": width, "cx": width / 2, "cy": height / 2}
        (tmp_path / "intrinsics.json").write_text(json.dumps({**camera, "depth_scale": 1000, **more}))
        return tmp_path

    return write


def test_times_are_judged_when_a_recording_is_opened(plain):
    with pytest.raises(SequenceError, match=r"fps"):
        open_sequence(plain(fps=1e-320))


def test_a_picture_of_one_pixel_is_no_camera(plain):
    with pytest.raises(SequenceError, match=r"at least 2 x 2"):
        open_sequence(plain(1, 1))


def exif(orientation: int) -> bytes:
    """The segment APP1 of a JPEG."""
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 274, 3, 1, orientation, 0, 0)
    body = b"Exif\0\0" + tiff
    return b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body


@pytest.mark.parametrize("orientation", [1, 6])
def test_turned_pictures_are_used_as_stored_and_that_is_said(plain, caplog, orientation):
    root = plain(suffix=".jpg")
    for path in (root / "rgb").iterdir():
        data = path.read_bytes()
        path.write_bytes(data[:2] + exif(orientation) + data[2:])
    assert is_to_be_turned(path.read_bytes()) == (orientation != 1)
    with caplog.at_level(logging.WARNING):
        frames = [open_sequence(root).mapping[i] for i in range(2)]
    assert all(tuple(frame.colour.shape) == (24, 32, 3) for frame in frames)
    said = [record for record in caplog.records if "EXIF" in record.getMessage()]
    assert len(said) == (orientation != 1)


def test_a_number_of_400_digits_is_no_size(tmp_path):
    (tmp_path / "cameras.txt").write_text(f"1 PINHOLE {'9' * 400} 480 500 500 320 240\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    with pytest.raises(SequenceError, match=r"camera 1: camera width"):
        read_model(tmp_path)


def splat(xyz=(0.0, 0.0, 1.0), scale=(0.1, 0.1, 0.1), quat=(255, 128, 128, 128)) -> bytes:
    return struct.pack("<6f4B4B", *xyz, *scale, 200, 100, 50, 255, *quat)


@pytest.mark.parametrize(
    ("bad", "named"),
    [
        ({"xyz": (5.9e34, 0.0, 0.0)}, "place"),
        ({"scale": (float(np.exp(49.0)), 0.1, 0.1)}, "size"),
        ({"scale": (0.1, float(np.exp(86.0)), 0.1)}, "size"),
        ({"quat": (128, 128, 128, 128)}, "quaternion"),
    ],
)
def test_impossible_gaussians_are_refused(tmp_path, bad, named):
    path = tmp_path / "a.splat"
    path.write_bytes(splat() + splat(**bad))
    with pytest.raises(SequenceError, match=rf"{named}.* row 1"):
        read_gaussians(path)
    path.write_bytes(splat())
    gaussians = read_gaussians(path)
    assert torch.allclose(gaussians.quat, torch.tensor([[127 / 128, 0.0, 0.0, 0.0]]))


def test_no_text_of_a_table_is_a_formula():
    assert [plain_cell(t) for t in ("=cmd|' /C calc'!A0", " =1", "-x", "a\nb")] == [
        "'=cmd|' /C calc'!A0", "' =1", "'-x", "a b"
    ]  # fmt: skip


def test_a_deleted_colour_image_is_named_by_a_live_source(plain):
    root = plain()
    (root / "rgb/1.png").unlink()
    source = GrowingFolder(root, idle_s=0.2, wait=lambda seconds: None)
    seen, said = [], []
    while True:
        try:
            seen.append(next(source).index)
        except StopIteration:
            break
        except BadFrameError as e:
            said.append(str(e))
    assert len(seen) == 2
    assert [str(root / "depth/1.png") in text for text in said] == [True]


def test_who_gives_a_bag_to_map_is_sent_to_convert(tmp_path):
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0")
    with pytest.raises(SequenceNotFoundError, match=r"gsfusion-nb convert"):
        open_sequence(tmp_path / "a.bag")
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information:")
    with pytest.raises(SequenceError, match=r"gsfusion-nb convert"):
        open_sequence(tmp_path)
