"""ROS 1 and ROS 2 bags, written by rosbags' own writers."""

import struct
from dataclasses import replace
from typing import Literal

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.data import SequenceError, folder
from gsfusion_nb.geometry import se3
from gsfusion_nb.recordings.convert import ConvertOptions, RosOptions, convert, detect_format
from gsfusion_nb.types import Camera

pytest.importorskip("rosbags")
from ros_bags import Bag
from rosbags.rosbag2 import StoragePlugin

T_BASE_CAM = se3.exp(torch.tensor([0.1, -0.05, 0.2, 1.2, -1.1, 1.25], dtype=torch.float64))
"""Optical frame to base: about the turn between ROS's body and optical axes."""


def write_tf(bag, takes):
    """map -> base moves, base -> optical is fixed; poses half a step before, at and behind the
    frames."""
    bag.tf("/tf_static", takes.times_s[0], "base_link", "camera_optical", T_BASE_CAM)
    for i, t in enumerate(takes.times_s):
        bag.tf(
            "/tf",
            t,
            "map",
            "base_link",
            takes.T_WC[i] @ se3.inverse(T_BASE_CAM),
        )


def write_bag(
    path,
    takes,
    version,
    *,
    colour="rgb8",
    depth="16UC1",
    poses="tf",
    pad=0,
    big=False,
    storage=None,
    bag_format: Literal[8, 9] = 9,
):
    with Bag(path, version, storage, bag_format) as bag:
        if poses == "tf":
            write_tf(bag, takes)
        for i, t in enumerate(takes.times_s):
            rgb = takes.rgb[i]
            bag.info("/camera/color/camera_info", t, "camera_optical", takes.camera)
            put_depth(bag, takes, i, depth, pad, big)
            if poses == "pose":
                bag.pose("/slam/pose", t, takes.T_WC[i])
            if colour == "png":
                bag.compressed(
                    "/camera/color/image_raw/compressed", t, "camera_optical", "png", takes.png(i)
                )
            else:
                pixels = {"rgb8": rgb, "bgr8": rgb[..., ::-1]}.get(colour)
                if colour == "bgra8":
                    pixels = np.concatenate(
                        [rgb[..., ::-1], np.full_like(rgb[..., :1], 7)],
                        -1,
                    )
                pixels = rgb if pixels is None else pixels
                bag.image("/camera/color/image_raw", t, "camera_optical", colour, pixels, pad=pad)
    return path


def put_depth(bag, takes, i, depth, pad, big):
    t = takes.times_s[i] + 0.004
    topic = "/camera/depth/image_raw"
    frame = "camera_optical"
    if depth == "16UC1":
        bag.image(
            topic,
            t,
            frame,
            depth,
            takes.depth_raw(i),
            pad=pad,
            big=big,
        )
    elif depth == "32FC1":
        bag.image(
            topic,
            t,
            frame,
            depth,
            takes.depth_m[i].astype(np.float32),
            pad=pad,
            big=big,
        )
    elif depth == "16UC1; compressedDepth png":
        data = struct.pack("<iff", 0, 0, 0) + takes.depth_png(i)
        bag.compressed(f"{topic}/compressedDepth", t, frame, depth, data)
    elif depth == "32FC1; compressedDepth png":
        # compressed_depth_image_transport: a = z_q (z_q + 1), b = 1 - a / z_max; q = a / z + b
        a = 100.0 * 101.0
        b = 1.0 - a / 10.0
        q = cv2.imencode(
            ".png",
            np.rint(a / takes.depth_m[i] + b).astype(np.uint16),
        )[1].tobytes()
        bag.compressed(
            f"{topic}/compressedDepth", t, frame, depth, struct.pack("<iff", 0, a, b) + q
        )
    else:
        bag.compressed(f"{topic}/compressedDepth", t, frame, depth, b"\0" * 40)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    ("colour", "depth", "poses"),
    [
        ("rgb8", "16UC1", "tf"),
        ("bgr8", "32FC1", "pose"),
        ("png", "16UC1; compressedDepth png", "tf"),
    ],
)
def test_reads_what_was_written(tmp_path, takes, version, colour, depth, poses):
    path = tmp_path / ("scan.bag" if version == 1 else "scan")
    write_bag(path, takes, version, colour=colour, depth=depth, poses=poses)
    assert detect_format(path) == "ros"
    report = convert(path, tmp_path / "out")
    takes.check(tmp_path / "out", pose=2e-6)
    assert report.dropped == {}
    rows = (tmp_path / "out/times.txt").read_text().splitlines()[1:]
    colour_s, depth_s = zip(
        *([float(t) for t in row.split()[1:]] for row in rows),
        strict=True,
    )
    assert colour_s == pytest.approx(takes.times_s, abs=1e-6)
    assert depth_s == pytest.approx([t + 0.004 for t in takes.times_s], abs=1e-6)


def test_mcap(tmp_path, takes):
    path = write_bag(tmp_path / "scan", takes, 2, storage=StoragePlugin.MCAP)
    convert(path, tmp_path / "out")
    takes.check(tmp_path / "out", pose=2e-6)
    alone = next(path.glob("*.mcap")).rename(tmp_path / "alone.mcap")
    assert detect_format(alone) == "ros"
    convert(alone, tmp_path / "again")
    takes.check(tmp_path / "again", pose=2e-6)


def test_ros2_bag_that_does_not_say_what_its_types_are(tmp_path, takes):
    """Before Iron, ROS 2 stored no message definitions with sqlite3."""
    path = write_bag(tmp_path / "scan", takes, 2, bag_format=8)
    convert(path, tmp_path / "out")
    takes.check(tmp_path / "out", pose=2e-6)


def test_padded_rows_and_byte_order(tmp_path, takes):
    convert(
        write_bag(tmp_path / "scan.bag", takes, 1, colour="bgra8", pad=3, big=True),
        tmp_path / "out",
    )
    takes.check(tmp_path / "out", pose=2e-6)


def test_quantised_inverse_depth(tmp_path, takes):
    path = write_bag(tmp_path / "scan.bag", takes, 1, depth="32FC1; compressedDepth png")
    convert(path, tmp_path / "out")
    # half a step is z^2 / 2a = 1 mm at 4.5 m
    takes.check(tmp_path / "out", depth_m=2e-3, pose=2e-6)


def test_depth_camera_beside_the_colour_camera(tmp_path, takes, box):
    """Unregistered depth of another size: tf_static says where its camera stands."""
    depth_camera = Camera(
        width=128,
        height=96,
        fx=110.0,
        fy=111.0,
        cx=62.0,
        cy=47.0,
    )
    T_CD = se3.exp(torch.tensor([0.05, 0.01, -0.01, 0.02, -0.04, 0.01], dtype=torch.float64))
    poses = box.poses(4)
    with Bag(tmp_path / "scan.bag", 1) as bag:
        bag.tf("/tf_static", 1.0, "colour", "depth", T_CD)
        for i, T in enumerate(poses):
            t = 1.0 + 0.1 * i
            bag.tf("/tf", t, "map", "colour", T)
            bag.info("/c/camera_info", t, "colour", box.camera)
            bag.info("/depth/camera_info", t, "depth", depth_camera)
            bag.image("/c/image", t, "colour", "rgb8", box.render(T)[0])
            depth = box.render(T @ T_CD, depth_camera)[1]
            bag.image("/depth/image", t, "depth", "32FC1", depth.astype(np.float32))
    report = convert(tmp_path / "scan.bag", tmp_path / "out")
    assert "depth (depth) was registered to colour (colour) by tf_static" in report.notes
    for frame in folder(tmp_path / "out"):
        assert float((frame.depth_m > 0).float().mean()) > 0.8
        assert box.off_wall_m(frame) < 0.02


def test_several_topics_have_to_be_named(tmp_path, takes):
    with Bag(tmp_path / "scan.bag", 1) as bag:
        write_tf(bag, takes)
        for i, t in enumerate(takes.times_s):
            bag.info("/a/camera_info", t, "camera_optical", takes.camera)
            for name in ("a", "b"):
                bag.image(f"/{name}/image", t, "camera_optical", "rgb8", takes.rgb[i])
            bag.image("/depth/image", t, "camera_optical", "16UC1", takes.depth_raw(i))
    for topic in ("", "/c"):
        options = ConvertOptions(ros=RosOptions(colour_topic=topic))
        with pytest.raises(SequenceError, match="/a/image, /b/image"):
            convert(tmp_path / "scan.bag", tmp_path / "out", options=options)
    options = ConvertOptions(ros=RosOptions(colour_topic="/a/image"))
    convert(tmp_path / "scan.bag", tmp_path / "out", options=options)
    takes.check(tmp_path / "out", pose=2e-6)


@pytest.mark.parametrize(
    ("options", "named"),
    [({"depth": "16UC1; compressedDepth rvl"}, "RVL"), ({"colour": "8SC3"}, "8SC3")],
)
def test_packings_that_cannot_be_read_are_named(tmp_path, takes, options, named):
    with pytest.raises(SequenceError, match=named):
        convert(write_bag(tmp_path / "a.bag", takes, 1, **options), tmp_path / "out")


def test_damaged_bags_and_clocks_that_differ_are_named(tmp_path, takes):
    path = write_bag(tmp_path / "c.bag", takes, 1)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(SequenceError, match=r"c\.bag"):
        convert(path, tmp_path / "out")
    late = replace(takes, times_s=[t + 5 for t in takes.times_s])
    with Bag(tmp_path / "d.bag", 1) as bag:
        for i in range(4):
            bag.image("/rgb", takes.times_s[i], "c", "rgb8", takes.rgb[i])
            put_depth(bag, late, i, "16UC1", 0, False)
    with pytest.raises(SequenceError, match=r"none of 4 images"):
        convert(tmp_path / "d.bag", tmp_path / "out")
