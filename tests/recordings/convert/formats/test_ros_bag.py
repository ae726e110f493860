"""ROS 1 and ROS 2 bags, written by rosbags' own writers."""

import struct
from dataclasses import dataclass, replace
from pathlib import Path
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
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

T_BASE_CAM = se3.exp(torch.tensor([0.1, -0.05, 0.2, 1.2, -1.1, 1.25], dtype=torch.float64))
"""Optical frame to base: about the turn between ROS's body and optical axes."""


@dataclass
class Bag:
    """Writes messages of either ROS into a bag."""

    path: Path
    version: int
    storage: StoragePlugin | None = None
    bag_format: Literal[8, 9] = 9

    def __enter__(self):
        self.store = get_typestore(Stores.ROS1_NOETIC if self.version == 1 else Stores.ROS2_HUMBLE)
        tf = get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
        self.store.register(tf)
        plugin = self.storage or StoragePlugin.SQLITE3
        self.writer = (
            Writer1(self.path)
            if self.version == 1
            else Writer2(self.path, version=self.bag_format, storage_plugin=plugin)
        )
        self.writer.open()
        self.connections = {}
        return self

    def __exit__(self, *_):
        self.writer.close()

    def make(self, kind, **fields):
        return self.store.types[kind](**fields)

    def header(self, time_s, frame):
        ns = round(time_s * 1e9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)
        extra = {"seq": 0} if self.version == 1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **extra)

    def put(self, topic, message, time_s):
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        pack = self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], round(time_s * 1e9), pack(message, kind))

    def image(self, topic, time_s, frame, encoding, pixels, *, pad=0, big=False):
        rows = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")))
        rows = rows.reshape(len(rows), -1).view(np.uint8)
        rows = np.concatenate([rows, np.full((len(rows), pad), 99, np.uint8)], axis=1)
        h, w = pixels.shape[:2]
        fields = {"height": h, "width": w, "encoding": encoding, "is_bigendian": int(big), "step": rows.shape[1]}
        header = self.header(time_s, frame)
        self.put(topic, self.make("sensor_msgs/msg/Image", header=header, data=rows.flatten(), **fields), time_s)

    def compressed(self, topic, time_s, frame, format, data):
        array = np.frombuffer(data, np.uint8)
        header = self.header(time_s, frame)
        message = self.make("sensor_msgs/msg/CompressedImage", header=header, format=format, data=array)
        self.put(topic, message, time_s)

    def info(self, topic, time_s, frame, c: Camera, D=(0.0,) * 5):
        K = np.array([c.fx, 0, c.cx - 0.5, 0, c.fy, c.cy - 0.5, 0, 0, 1])
        P = np.insert(K.reshape(3, 3), 3, 0, axis=1).flatten()
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        values = {"D": np.array(D), "K": K, "R": np.eye(3).flatten(), "P": P}
        values = values if self.version == 1 else {k.lower(): v for k, v in values.items()}
        fields = {"height": c.height, "width": c.width, "distortion_model": "plumb_bob", "roi": roi}
        fields |= {"binning_x": 0, "binning_y": 0, "header": self.header(time_s, frame)}
        self.put(topic, self.make("sensor_msgs/msg/CameraInfo", **fields, **values), time_s)

    def row(self, T):
        from gsfusion_nb.geometry import quaternion

        xyz, q = T[:3, 3].tolist(), quaternion.from_matrix(T[:3, :3]).tolist()
        return dict(zip("xyz", xyz, strict=True)), {"w": q[0], "x": q[1], "y": q[2], "z": q[3]}

    def tf(self, topic, time_s, parent, child, T):
        xyz, q = self.row(T)
        transform = self.make(
            "geometry_msgs/msg/Transform",
            translation=self.make("geometry_msgs/msg/Vector3", **xyz),
            rotation=self.make("geometry_msgs/msg/Quaternion", **q),
        )
        stamped = self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(time_s, parent),
            child_frame_id=child,
            transform=transform,
        )
        kind = "tf2_msgs/msg/TFMessage"
        self.put(topic, self.make(kind, transforms=[stamped]), time_s)

    def pose(self, topic, time_s, T):
        xyz, q = self.row(T)
        pose = self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", **xyz),
            orientation=self.make("geometry_msgs/msg/Quaternion", **q),
        )
        header = self.header(time_s, "map")
        self.put(topic, self.make("geometry_msgs/msg/PoseStamped", header=header, pose=pose), time_s)


def write_tf(bag, takes):
    """map -> base moves, base -> optical is fixed; poses half a step before, at and behind the frames."""
    bag.tf("/tf_static", takes.times_s[0], "base_link", "camera_optical", T_BASE_CAM)
    for i, t in enumerate(takes.times_s):
        bag.tf("/tf", t, "map", "base_link", takes.T_WC[i] @ se3.inverse(T_BASE_CAM))


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
                bag.compressed("/camera/color/image_raw/compressed", t, "camera_optical", "png", takes.png(i))
            else:
                pixels = {"rgb8": rgb, "bgr8": rgb[..., ::-1]}.get(colour)
                if colour == "bgra8":
                    pixels = np.concatenate([rgb[..., ::-1], np.full_like(rgb[..., :1], 7)], -1)
                pixels = rgb if pixels is None else pixels
                bag.image("/camera/color/image_raw", t, "camera_optical", colour, pixels, pad=pad)
    return path


def put_depth(bag, takes, i, depth, pad, big):
    t, topic, frame = takes.times_s[i] + 0.004, "/camera/depth/image_raw", "camera_optical"
    if depth == "16UC1":
        bag.image(topic, t, frame, depth, takes.depth_raw(i), pad=pad, big=big)
    elif depth == "32FC1":
        bag.image(topic, t, frame, depth, takes.depth_m[i].astype(np.float32), pad=pad, big=big)
    elif depth == "16UC1; compressedDepth png":
        data = struct.pack("<iff", 0, 0, 0) + takes.depth_png(i)
        bag.compressed(f"{topic}/compressedDepth", t, frame, depth, data)
    elif depth == "32FC1; compressedDepth png":
        # compressed_depth_image_transport: a = z_q (z_q + 1), b = 1 - a / z_max; q = a / z + b
        a = 100.0 * 101.0
        b = 1.0 - a / 10.0
        q = cv2.imencode(".png", np.rint(a / takes.depth_m[i] + b).astype(np.uint16))[1].tobytes()
        bag.compressed(f"{topic}/compressedDepth", t, frame, depth, struct.pack("<iff", 0, a, b) + q)
    else:
        bag.compressed(f"{topic}/compressedDepth", t, frame, depth, b"\0" * 40)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    ("colour", "depth", "poses"),
    [("rgb8", "16UC1", "tf"), ("bgr8", "32FC1", "pose"), ("png", "16UC1; compressedDepth png", "tf")],
)
def test_reads_what_was_written(tmp_path, takes, version, colour, depth, poses):
    path = tmp_path / ("scan.bag" if version == 1 else "scan")
    write_bag(path, takes, version, colour=colour, depth=depth, poses=poses)
    assert detect_format(path) == "ros"
    report = convert(path, tmp_path / "out")
    takes.check(tmp_path / "out", pose=2e-6)
    assert report.dropped == {}
    rows = (tmp_path / "out/times.txt").read_text().splitlines()[1:]
    colour_s, depth_s = zip(*([float(t) for t in row.split()[1:]] for row in rows), strict=True)
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
    convert(write_bag(tmp_path / "scan.bag", takes, 1, colour="bgra8", pad=3, big=True), tmp_path / "out")
    takes.check(tmp_path / "out", pose=2e-6)


def test_quantised_inverse_depth(tmp_path, takes):
    path = write_bag(tmp_path / "scan.bag", takes, 1, depth="32FC1; compressedDepth png")
    convert(path, tmp_path / "out")
    takes.check(tmp_path / "out", depth_m=2e-3, pose=2e-6)  # half a step is z^2 / 2a = 1 mm at 4.5 m


def test_depth_camera_beside_the_colour_camera(tmp_path, takes, box):
    """Unregistered depth of another size: tf_static says where its camera stands."""
    depth_camera = Camera(width=128, height=96, fx=110.0, fy=111.0, cx=62.0, cy=47.0)
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
    ("options", "named"), [({"depth": "16UC1; compressedDepth rvl"}, "RVL"), ({"colour": "8SC3"}, "8SC3")]
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
