"""The plain layout, and every way in which it can be wrong."""

import logging
import struct

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.config import DataConfig
from gsfusion_nb.data import BadFrameError, Sequence, SequenceError, folder, open_sequence
from gsfusion_nb.data.adjust.depth_agreement import depth_agreement

REAL = {"redkitchen_mini48": 48, "redkitchen250": 250, "livingroom1_clean211": 211}


def test_reads_what_was_written(tmp_path, box):
    seq = folder(box.folder(tmp_path / "scan"))
    assert isinstance(seq, Sequence)
    assert (len(seq), seq.name) == (4, "scan")
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(seq.camera, name) == pytest.approx(getattr(box.camera, name))
    for i, frame in enumerate(seq):
        rgb, depth_m = box.render(box.poses(4)[i])
        assert frame.index == i
        assert frame.timestamp_s == pytest.approx(i / 30)
        assert frame.rgb.dtype == frame.depth_m.dtype == frame.T_WC.dtype == torch.float32
        # JPEG; swapped channels give far more
        assert np.abs(frame.rgb.numpy() * 255 - rgb).mean() < 3
        assert np.abs(frame.depth_m.numpy() - depth_m).max() < 0.00051
        assert torch.allclose(
            frame.T_WC.double(),
            box.poses(4)[i],
            atol=1e-6,
        )
        assert torch.equal(frame.T_WC, seq.pose(i))
        assert box.off_wall_m(frame) < 0.0005


def test_depth_scale_invalid_value_and_fps(tmp_path, box):
    root = box.folder(
        tmp_path, depth_invalid=777, fps=10, pose_convention="camera-to-world, made by hand"
    )
    raw = np.full((48, 64), 2000, np.uint16)
    raw[0, 0] = 0
    raw[1, 1] = 777
    cv2.imwrite(str(root / "depth/000001.png"), raw)
    frame = folder(root)[1]
    assert frame.depth_m[0, 0] == frame.depth_m[1, 1] == 0
    assert frame.depth_m[2, 2] == 2.0
    assert frame.timestamp_s == pytest.approx(0.1)


def test_poses_by_name_and_by_number(tmp_path, box):
    root = box.folder(tmp_path / "scan", n=6)
    whole = folder(root)
    lines = (root / "poses.txt").read_text().splitlines(keepends=True)
    for kind, suffix in (("rgb", "jpg"), ("depth", "png")):
        (root / kind / f"000002.{suffix}").unlink()
    expect(SequenceError, r"holds 6 poses; expected 5, .*name of its image", lambda: folder(root))
    wanted = whole.poses[[0, 1, 3, 4, 5]]
    (root / "poses.txt").write_text(
        "".join(f"{i:06d} {line}" for i, line in reversed(list(enumerate(lines))))
    )
    assert torch.equal(folder(root).poses, wanted)
    (root / "poses.txt").write_text("".join(lines[:5]))
    assert len(folder(root)) == 5  # as many lines as images: taken by order
    (root / "poses.txt").write_text("".join(f"{i}.jpg {line}" for i, line in enumerate(lines[:5])))
    expect(SequenceError, r"has no pose of .*000005.jpg", lambda: folder(root))
    (root / "poses.txt").write_text("".join(f"3 {line}" for line in lines[:5]))
    expect(SequenceError, r"holds two poses of 3", lambda: folder(root))


def test_own_times_are_kept(tmp_path, box):
    root = box.folder(tmp_path / "scan", n=3)
    (root / "times.txt").write_text("frame time_s\n000002 107.5\n000000 100.25\n000001 103.0\n")
    assert folder(root).timestamps_s == [100.25, 103.0, 107.5]
    assert folder(root).depth_times_s is None
    (root / "times.txt").write_text("frame time_s depth_time_s\n0 1 1.02\n1 2 2.01\n2 3 3\n")
    assert (folder(root).timestamps_s, folder(root).depth_times_s) == ([1, 2, 3], [1.02, 2.01, 3])
    (root / "times.txt").write_text("0 1 1.02 4\n1 2 2.01\n2 3 3\n")
    expect(SequenceError, r"times.txt line 1 must be 'name seconds'", lambda: folder(root))
    (root / "times.txt").write_text("frame time_s\n" + "".join(f"{i:06d} nan\n" for i in range(3)))
    assert folder(root).timestamps_s == [0, 1 / 30, 2 / 30]
    (root / "times.txt").write_text("0 1.0\n")
    expect(SequenceError, r"times.txt has no time of .*000001.jpg", lambda: folder(root))
    (root / "times.txt").write_text("0 noon\n")
    expect(SequenceError, r"times.txt line 1 must be 'name seconds'", lambda: folder(root))


def expect(error, pattern, act):
    """``act`` raises exactly ``error`` with one sentence (no line break) matching ``pattern``."""
    with pytest.raises(error, match=pattern) as caught:
        act()
    assert type(caught.value) is error
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("fz", 1.0),
        ("fx", None),
        ("fx", "525"),
        ("fx", 0),
        ("depth_scale", -1000),
        ("pixel_centre", 0.25),
        ("depth_invalid", 70000),
        ("fps", 0),
        ("fps", 1e-320),
        ("pose_convention", "world-to-camera"),
    ],
)
def test_bad_intrinsics(tmp_path, box, key, value):
    root = box.folder(tmp_path, **{key: value})
    expect(SequenceError, rf"intrinsics\.json.*{key}", lambda: folder(root))


@pytest.mark.parametrize(
    "lines", ["", "1 2 3\n", "# c\n" + "x " * 16 + "\n", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n" * 3]
)
def test_bad_pose_files(tmp_path, box, lines):
    root = box.folder(tmp_path)
    (root / "poses.txt").write_text(lines)
    expect(SequenceError, r"poses\.txt", lambda: folder(root))


@pytest.mark.parametrize(
    ("pose", "pattern"),
    [
        ("nan " * 16, "pose 1 has NaN or infinite entries"),
        ("-inf " * 16, "pose 1 has NaN or infinite entries.*tracking was lost"),
        (
            "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1",
            "pose 1 is not a rigid camera-to-world pose: .*misses R R\\^T = I",
        ),
        ("1 0 0 0 0 1 0 0 0 0 -1 0 0 0 0 1", "pose 1 is not a rigid .*determinant -1"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 1 2 3 1", "pose 1 is not a rigid .*end in the row"),
    ],
)
def test_bad_poses_spoil_one_frame_only(tmp_path, box, pose, pattern):
    root = box.folder(tmp_path)
    lines = (root / "poses.txt").read_text().splitlines()
    lines[1] = pose
    (root / "poses.txt").write_text("\n".join(lines))
    seq = folder(root)
    expect(BadFrameError, r"poses\.txt " + pattern, lambda: seq[1])
    expect(BadFrameError, pattern, lambda: seq.pose(1))
    assert seq[0].index == 0
    assert seq[2].index == 2


@pytest.mark.parametrize("name", ["rgb/000001.jpg", "depth/000001.png"])
@pytest.mark.parametrize("keep", [0.0, 0.3, 0.9, 0.9999])
def test_truncated_images(tmp_path, box, name, keep):
    root = box.folder(tmp_path)
    whole = (root / name).read_bytes()
    (root / name).write_bytes(whole[: int(keep * len(whole))])
    seq = folder(root)
    expect(
        BadFrameError,
        name + r" (is empty|is truncated|cannot be decoded).*expected a",
        lambda: seq[1],
    )
    assert seq[2].index == 2


def test_wrong_sizes(tmp_path, box):
    root = box.folder(tmp_path)
    box.write_depth(root / "depth/000001.png", np.ones((24, 32)), 1000)
    seq = folder(root)
    expect(
        BadFrameError,
        r"000001\.png is 32x24; expected 64x48, as the intrinsics say, and registered to colour",
        lambda: seq[1],
    )
    box.write_rgb(root / "rgb/000001.jpg", np.zeros((24, 32, 3), np.uint8))
    expect(
        BadFrameError,
        r"000001\.jpg is 32x24; expected 64x48, as the intrinsics say",
        lambda: seq[1],
    )


@pytest.mark.parametrize(
    "image",
    [
        np.full((48, 64), 200, np.uint8),
        np.full((48, 64, 3), 200, np.uint16),
        np.full((48, 64), 777, np.uint16),
    ],
)
def test_bad_depth_images(tmp_path, box, image):
    root = box.folder(tmp_path, depth_invalid=777)
    cv2.imwrite(str(root / "depth/000001.png"), image)
    seq = folder(root)
    expect(BadFrameError, r"000001\.png", lambda: seq[1])
    assert seq[0].index == 0


def test_a_colour_image_is_no_depth(tmp_path, box):
    root = box.folder(tmp_path)
    cv2.imwrite(
        str(root / "depth/000001.png"),
        np.full((48, 64, 3), 200, np.uint8),
    )
    seq = folder(root)
    expect(
        BadFrameError, r"000001\.png is a colour image of 3 channels .* packed into", lambda: seq[1]
    )


def test_dark_colour_of_16_bits_is_told(tmp_path, box, caplog):
    """12 bits in an image of 16 are 16 times too dark; 8 bits spread over 16 are right."""
    grey = np.tile(np.arange(64, dtype=np.uint16) * 4, (48, 1))
    as_8_bits = torch.from_numpy(grey[0]).float()
    for factor, told, bits in ((257, False, 16), (16, True, 16), (16, False, 12)):
        root = box.folder(tmp_path / f"{factor}-{bits}")
        (root / "rgb/000001.jpg").unlink()
        cv2.imwrite(str(root / "rgb/000001.png"), grey * factor)
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            rgb = folder(root, colour_bits=bits)[1].rgb
        expected = torch.floor(as_8_bits / 16) if told else as_8_bits
        assert torch.allclose(rgb[0, :, 0] * 255, expected, atol=1)
        assert ("use 12 or fewer" in caplog.text) == told
        assert ("--reader colour_bits=12" in caplog.text) == told


def test_more_bits_than_said_are_refused(tmp_path, box):
    root = box.folder(tmp_path)
    (root / "rgb/000001.jpg").unlink()
    cv2.imwrite(str(root / "rgb/000001.png"), np.full((48, 64), 4096, np.uint16))
    expect(
        BadFrameError,
        r"000001\.png holds the value 4096.* 12 bits .* colour_bits of 13 or more",
        lambda: folder(root, colour_bits=12)[1],
    )
    expect(SequenceError, "colour_bits must be 8 to 16, got 4", lambda: folder(root, colour_bits=4))


def test_images_of_8_bits_have_all_their_bits(tmp_path, box):
    root = box.folder(tmp_path)
    for frame, same in zip(folder(root), folder(root, colour_bits=12), strict=True):
        assert torch.equal(frame.rgb_u8, same.rgb_u8)


def test_webp_is_colour(tmp_path, box):
    root = box.folder(tmp_path)
    as_jpeg = [frame.rgb_u8 for frame in folder(root)]
    for file in list((root / "rgb").iterdir()):
        lossless = [cv2.IMWRITE_WEBP_QUALITY, 101]
        picture = cv2.imread(str(file))
        assert picture is not None
        cv2.imwrite(str(file.with_suffix(".webp")), picture, lossless)
        file.unlink()
    for frame, expected in zip(folder(root), as_jpeg, strict=True):
        assert torch.equal(frame.rgb_u8, expected)


@pytest.mark.parametrize("width", [0, 160])
@pytest.mark.parametrize("name", REAL)
def test_neighbouring_frames_of_real_sequences_agree(shared_sequence, name, width):
    seq = open_sequence(shared_sequence(name), data=DataConfig(width=width))
    assert len(seq) == REAL[name]
    # measured at worst: synthetic depth 0.8 mm at 640x480 and 3.0 mm at 160x120; Kinect 8 mm, its
    # own noise
    bound_m = 0.004 if name == "livingroom1_clean211" else 0.009
    for i in range(
        0,
        len(seq) - 1,
        max(1, len(seq) // 6),
    ):
        agreement = depth_agreement(seq[i], seq[i + 1])
        assert agreement.median_m < bound_m
        assert agreement.agreeing > 0.85


@pytest.mark.parametrize("orientation", [1, 6])
def test_turned_pictures_are_used_as_stored_and_that_is_said(tmp_path, box, caplog, orientation):
    root = box.folder(tmp_path / "scan")
    tiff = b"II*\0" + struct.pack(
        "<IHHHIHHI",
        8,
        1,
        274,
        3,
        1,
        orientation,
        0,
        0,
    )
    body = b"Exif\0\0" + tiff
    for path in (root / "rgb").iterdir():
        data = path.read_bytes()
        path.write_bytes(
            data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:]
        )
    assert [tuple(frame.colour.shape) for frame in folder(root)] == [(48, 64, 3)] * 4
    assert len([record for record in caplog.records if "EXIF" in record.getMessage()]) == (
        orientation != 1
    )
