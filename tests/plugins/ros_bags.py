"""Writes bags of either ROS, by rosbags' own writers."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gsfusion_nb.types import Camera


@dataclass
class Bag:
    """Writes messages of either ROS into a bag."""

    path: Path
    version: int
    storage: StoragePlugin | None = None
    bag_format: Literal[8, 9] = 9

    def __enter__(self):
        self.store = get_typestore(Stores.ROS1_NOETIC if self.version == 1 else Stores.ROS2_HUMBLE)
        tf = get_types_from_msg(
            "geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"
        )
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

    def put(self, topic, message, time_s, tail=b""):
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        pack = self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr
        self.writer.write(
            self.connections[topic],
            round(time_s * 1e9),
            bytes(pack(message, kind)) + tail,
        )

    def image(
        self,
        topic,
        time_s,
        frame,
        encoding,
        pixels,
        *,
        pad=0,
        big=False,
        tail=b"",
    ):
        rows = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")))
        rows = rows.reshape(len(rows), -1).view(np.uint8)
        rows = np.concatenate(
            [rows, np.full((len(rows), pad), 99, np.uint8)],
            axis=1,
        )
        h, w = pixels.shape[:2]
        fields = {
            "height": h,
            "width": w,
            "encoding": encoding,
            "is_bigendian": int(big),
            "step": rows.shape[1],
        }
        header = self.header(time_s, frame)
        self.put(
            topic,
            self.make("sensor_msgs/msg/Image", header=header, data=rows.flatten(), **fields),
            time_s,
            tail,
        )

    def compressed(self, topic, time_s, frame, format, data):
        array = np.frombuffer(data, np.uint8)
        header = self.header(time_s, frame)
        message = self.make(
            "sensor_msgs/msg/CompressedImage", header=header, format=format, data=array
        )
        self.put(topic, message, time_s)

    def info(
        self,
        topic,
        time_s,
        frame,
        c: Camera,
        D=(0.0,) * 5,
        *,
        model="plumb_bob",
        roi=(0, 0, 0, 0),
        zeros=False,
    ):
        K = np.array([c.fx, 0, c.cx - 0.5, 0, c.fy, c.cy - 0.5, 0, 0, 1])
        K = np.zeros(9) if zeros else K
        P = np.insert(K.reshape(3, 3), 3, 0, axis=1).flatten()
        area = dict(zip(("x_offset", "y_offset", "width", "height"), roi, strict=True))
        part = self.make("sensor_msgs/msg/RegionOfInterest", do_rectify=False, **area)
        values = {"D": np.array(D), "K": K, "R": np.eye(3).flatten(), "P": P}
        values = values if self.version == 1 else {k.lower(): v for k, v in values.items()}
        fields = {"height": c.height, "width": c.width, "distortion_model": model, "roi": part}
        fields |= {"binning_x": 0, "binning_y": 0, "header": self.header(time_s, frame)}
        self.put(topic, self.make("sensor_msgs/msg/CameraInfo", **fields, **values), time_s)

    def row(self, T):
        from gsfusion_nb.geometry import quaternion

        xyz = T[:3, 3].tolist()
        q = quaternion.from_matrix(T[:3, :3]).tolist()
        return dict(zip("xyz", xyz, strict=True)), {"w": q[0], "x": q[1], "y": q[2], "z": q[3]}

    def tf(self, topic, time_s, parent, child, T, *, kind="tf2_msgs/msg/TFMessage"):
        stamped = self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(time_s, parent),
            child_frame_id=child,
            transform=self.transform(T),
        )
        self.put(topic, self.make(kind, transforms=[stamped]), time_s)

    def transform(self, T):
        xyz, q = self.row(T)
        return self.make(
            "geometry_msgs/msg/Transform",
            translation=self.make("geometry_msgs/msg/Vector3", **xyz),
            rotation=self.make("geometry_msgs/msg/Quaternion", **q),
        )

    def pose_of(self, T):
        xyz, q = self.row(T)
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", **xyz),
            orientation=self.make("geometry_msgs/msg/Quaternion", **q),
        )

    def pose(self, topic, time_s, T):
        header = self.header(time_s, "map")
        self.put(
            topic,
            self.make("geometry_msgs/msg/PoseStamped", header=header, pose=self.pose_of(T)),
            time_s,
        )

    def odometry(self, topic, time_s, child, T):
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        with_covariance = {"covariance": np.zeros(36)}
        message = self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(time_s, "odom"),
            child_frame_id=child,
            pose=self.make(
                "geometry_msgs/msg/PoseWithCovariance", pose=self.pose_of(T), **with_covariance
            ),
            twist=self.make(
                "geometry_msgs/msg/TwistWithCovariance", twist=twist, **with_covariance
            ),
        )
        self.put(topic, message, time_s)
