"""ROS 1 bags and ROS 2 bags (sqlite3, mcap), read with the pure-Python package ``rosbags``; no ROS is needed.

Colour and depth are paired by the times in their headers; poses come from tf or a topic of poses, interpolated at the
depth image's time. Depth is 16UC1 in millimetres or 32FC1 in metres (REP 118), pixel centres at integers, the image's
frame has OpenCV axes (REP 103 "optical").
"""

import io
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ....checks import shown
from ....data.lens import CameraModel
from ....data.recorded.times import associate
from ....data.sequence import SequenceError, SequenceNotFoundError
from ....files import open_regular, parsing
from ..intrinsics import model_of
from ..recording import ConvertOptions, RecordedFrame, Recording, RgbdImages
from ..trajectory import Trajectory, camera_in_body
from .ros_messages import (
    POSE_TYPES,
    TransformTree,
    colour_of,
    depth_of,
    in_order,
    pose_rows,
    seconds,
    stores_millimetres,
)

MAX_TIME_DIFFERENCE_S = 0.02
_TF_MESSAGE = "geometry_msgs/TransformStamped[] transforms"
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")


@dataclass
class _Bag:
    """What the first pass over a bag collects: everything except the pixels."""

    path: Path
    colour: str = ""
    depth: str = ""
    pose: str = ""
    """Topic of poses, or "tf", or "" without."""
    colour_s: list[float] = field(default_factory=list)
    depth_s: list[float] = field(default_factory=list)
    frames: dict[str, str] = field(default_factory=dict)
    """Frame of the images, by topic."""
    info: dict[str, Any] = field(default_factory=dict)
    """First CameraInfo, by topic."""
    tree: TransformTree = field(default_factory=TransformTree)
    pose_s: list[float] = field(default_factory=list)
    pose_rows: list[list[float]] = field(default_factory=list)
    body: str = ""
    millimetres: bool = True


LOOKS_FOR = "a .bag or .mcap file, or a folder with metadata.yaml"


def recognise(path: Path) -> bool:
    """A .bag or .mcap file, or the folder of a ROS 2 bag."""
    return path.suffix in (".bag", ".mcap", ".db3") if path.is_file() else (path / "metadata.yaml").is_file()


def read(path: Path, options: ConvertOptions) -> Recording:
    """Colour and depth of a bag (module docstring).

    Raises:
        SequenceError: the package ``rosbags`` is missing, the bag is damaged, a topic is missing or ambiguous (the
            message lists the candidates), or no depth image has a colour image near in time.
    """
    bag = _first_pass(path, options)
    pairs = associate(bag.depth_s, bag.colour_s, max_difference_s=MAX_TIME_DIFFERENCE_S)
    if not pairs:
        raise SequenceError(
            f"{path}: none of {len(bag.depth_s)} images of {bag.depth} has an image of {bag.colour} within "
            f"{MAX_TIME_DIFFERENCE_S} s; expected the header stamps of both cameras to come from one clock"
        )
    model, depth_model, T_colour_depth, notes = _cameras(bag)
    pose_at = _pose_lookup(bag, options, notes)

    def recorded_frames() -> Iterator[RecordedFrame]:
        for d, colour, depth in _second_pass(bag, pairs):
            time_s, depth_time_s = seconds(colour.header.stamp), bag.depth_s[d]
            if pose_at is not None and pose_at(time_s) is None:  # poses may have the stamps of depth
                time_s = depth_time_s
            source = f"{path}: {bag.depth} image {d}"
            yield RecordedFrame(
                source=source,
                time_s=time_s,
                depth_time_s=depth_time_s,
                model=model,
                depth_model=depth_model,
                T_colour_depth=T_colour_depth,
                T_WC=None if pose_at is None else pose_at(time_s),
                load=partial(_load, colour, depth, options.depth_scale, source),
            )

    alone = len(bag.depth_s) - len(pairs)
    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(pairs),
        depth_scale=options.depth_scale or (1000.0 if bag.millimetres else 1.0),
        has_poses=pose_at is not None,
        dropped={"no colour image near in time": alone} if alone else {},
        notes=(f"colour {bag.colour}, depth {bag.depth}, poses {bag.pose or 'none'}", *notes),
    )


def _load(colour: Any, depth: Any, scale: float, source: str) -> RgbdImages:
    rgb, encoded = colour_of(colour, f"{source} (colour)")
    return RgbdImages(rgb, depth_of(depth, source, scale), encoded)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A reader of the bag; its errors are raised as ``SequenceError``."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise SequenceError(
            f"{path} is a ROS bag, which needs the package rosbags: pip install 'gsfusion-nb[ros]'"
        ) from None
    if not path.exists():
        raise SequenceNotFoundError(f"{path} does not exist; expected a .bag file or the folder of a ROS 2 bag")
    folder = path.parent if path.suffix == ".db3" else path
    types = get_typestore(Stores.ROS2_HUMBLE)  # ROS 2 bags before Iron do not contain their message types
    types.register(get_types_from_msg(_TF_MESSAGE, "tf2_msgs/msg/TFMessage"))
    for file in [folder] if folder.is_file() else sorted(folder.iterdir()):
        open_regular(file, "a file of a ROS bag").close()
    what = "a ROS bag; if it is truncated or was not closed after recording, try 'rosbag reindex' or 'ros2 bag reindex'"
    with parsing(path, what), AnyReader([_BagPath(folder)], default_typestore=types) as reader:
        yield reader


def _first_pass(path: Path, options: ConvertOptions) -> _Bag:
    """Times, calibrations, transforms and poses; image messages are read but not kept."""
    bag = _Bag(path)
    with _opened(path) as reader:
        types = {c.topic: c.msgtype for c in reader.connections}
        _choose_topics(bag, types, options)
        wanted = {bag.colour, bag.depth, "/tf", "/tf_static", bag.pose}
        wanted |= {t for t, kind in types.items() if kind.endswith("/CameraInfo")}
        for connection, _, raw in reader.messages([c for c in reader.connections if c.topic in wanted]):
            _take(bag, connection, reader.deserialize(raw, connection.msgtype))
    if options.ros.pose_topic in ("", "tf") and not bag.pose and "/tf" in types and not options.poses:
        bag.pose = "tf"
    return bag


def _take(bag: _Bag, connection: Any, message: Any) -> None:
    topic = connection.topic
    if topic in (bag.colour, bag.depth):
        if topic not in bag.frames:
            bag.frames[topic] = message.header.frame_id.lstrip("/")
            bag.millimetres = stores_millimetres(message) if topic == bag.depth else bag.millimetres
        (bag.colour_s if topic == bag.colour else bag.depth_s).append(seconds(message.header.stamp))
    elif connection.msgtype.endswith("/TFMessage"):
        bag.tree.add(message, static=topic == "/tf_static")
    elif connection.msgtype.endswith("/CameraInfo"):
        bag.info.setdefault(topic, message)
    else:
        row, bag.body = pose_rows(message)
        bag.pose_s.append(seconds(message.header.stamp))
        bag.pose_rows.append(row)


def _choose_topics(bag: _Bag, types: dict[str, str], options: ConvertOptions) -> None:
    images = [t for t, kind in types.items() if kind in _IMAGES]
    depth = [t for t in images if "depth" in t.lower()]
    aligned = [t for t in depth if any(word in t for word in ("aligned", "registered"))]
    colour = [t for t in images if t not in depth and "infra" not in t and "/ir/" not in t]
    bag.depth = _one(options.ros.depth_topic, aligned or depth, images, "depth image", "--ros.depth-topic", bag.path)
    bag.colour = _one(options.ros.colour_topic, colour, images, "colour image", "--ros.colour-topic", bag.path)
    poses = [t for t, kind in types.items() if kind.rsplit("/", 1)[-1] in POSE_TYPES]
    wanted = options.ros.pose_topic
    if options.poses or wanted == "tf":
        return
    if wanted or (poses and "/tf" not in types):
        bag.pose = _one(wanted, poses, poses, "pose", "--ros.pose-topic", bag.path)


def _one(wanted: str, candidates: list[str], known: list[str], what: str, option: str, path: Path) -> str:
    """The requested topic, or the only candidate; where there is a raw and a compressed one, the raw one."""
    if wanted:
        if wanted not in known:
            raise SequenceError(
                f"{path} has no {what} topic {shown(wanted)}; it has {', '.join(sorted(known)) or 'none'}"
            )
        return wanted
    raw = [t for t in candidates if not any(t != o and t.startswith(f"{o}/") for o in candidates)]
    if len(raw) == 1:
        return raw[0]
    listed = ", ".join(sorted(candidates)) or f"none among {', '.join(sorted(known)) or 'no image topics at all'}"
    raise SequenceError(f"{path} must have one {what} topic, found: {listed}; name one with {option}")


def _second_pass(bag: _Bag, pairs: list[tuple[int, int]]) -> Iterator[tuple[int, Any, Any]]:
    """Depth number and both messages of every pair, in the order in which pairs become complete in the bag.

    Only messages whose partner has not been read yet are kept: as many as one stream is behind the other.
    """
    partner = [{c: d for d, c in pairs}, {d: d for d, _ in pairs}]
    waiting: dict[int, tuple[int, Any]] = {}
    seen = [0, 0]
    with _opened(bag.path) as reader:
        connections = [c for c in reader.connections if c.topic in (bag.colour, bag.depth)]
        for connection, _, raw in reader.messages(connections):
            kind = 0 if connection.topic == bag.colour else 1
            d = partner[kind].get(seen[kind])
            seen[kind] += 1
            if d is None:
                continue
            message = reader.deserialize(raw, connection.msgtype)
            other = waiting.pop(d, None)
            if other is None:
                waiting[d] = (kind, message)
                continue
            colour, depth = (message, other[1]) if kind == 0 else (other[1], message)
            yield d, colour, depth


def _cameras(bag: _Bag) -> tuple[CameraModel | None, CameraModel | None, Float[Tensor, "4 4"] | None, list[str]]:
    """Colour camera, depth camera if it is another one, the transform between them, and notes."""
    infos = {kind: _info_of(bag, topic) for kind, topic in (("colour", bag.colour), ("depth", bag.depth))}
    model = None if infos["colour"] is None else _model(infos["colour"], bag.colour, bag.path)
    frames = [bag.frames.get(t, "") for t in (bag.colour, bag.depth)]
    registered = frames[0] == frames[1] or any(w in bag.depth for w in ("aligned", "registered"))
    if registered or infos["depth"] is None or infos["depth"] is infos["colour"] or model is None:
        why = "it is in the colour camera's frame" if registered else "no camera_info says otherwise"
        return model, None, None, [f"depth is taken as registered to colour ({why})"]
    T = bag.tree.between(frames[1], frames[0])
    found = "by tf_static" if T is not None else "WITHOUT their offset, since tf_static lacks it"
    note = f"depth ({frames[1]}) was registered to colour ({frames[0]}) {found}"
    return model, _model(infos["depth"], bag.depth, bag.path), T, [note]


def _info_of(bag: _Bag, topic: str) -> Any:
    """CameraInfo beside an image topic: in the nearest common namespace."""
    parts = topic.split("/")
    for n in range(len(parts) - 1, 1, -1):
        found = bag.info.get("/".join([*parts[:n], "camera_info"]))
        if found is not None:
            return found
    return next(iter(bag.info.values())) if len(bag.info) == 1 else None


def _model(info: Any, topic: str, path: Path) -> CameraModel:
    """Camera of a CameraInfo; of a rectified topic, of its projection matrix P."""
    source = f"{path}: the camera_info of {topic}"
    size = (int(info.width), int(info.height))
    K, D, P = ([float(v) for v in getattr(info, n, getattr(info, n.lower(), ()))] for n in ("K", "D", "P"))
    if len(D) > 14:
        raise SequenceError(f"{source} has {len(D)} numbers of distortion; expected at most 14")
    if re.search(r"(^|[/_])rect", topic) and P[0] > 0:
        return model_of([P[0], P[5], P[2], P[6]], size, source, centre=0.0)
    kind = info.distortion_model
    if any(D) and kind not in ("plumb_bob", "rational_polynomial", "equidistant", "fisheye", "none", ""):
        raise SequenceError(
            f"{source} has the distortion model {shown(kind)}; known: plumb_bob, rational_polynomial, equidistant"
        )
    fisheye = kind in ("equidistant", "fisheye") and any(D)
    return model_of([K[0], K[4], K[2], K[5]], size, source, centre=0.0, distortion=tuple(D), fisheye=fisheye)


def _pose_lookup(bag: _Bag, options: ConvertOptions, notes: list[str]):
    """Function from time to camera pose, or None where the bag has no poses (or others are given)."""
    camera, gap = bag.frames.get(bag.colour, ""), options.max_gap_s
    if not bag.pose:
        return None
    if bag.pose == "tf":
        world = options.ros.world_frame or bag.tree.root(camera)
        if not bag.tree.knows(camera, world) or world == camera:
            if not options.ros.world_frame:
                return None
            raise SequenceError(
                f"{bag.path}: tf does not lead from the camera's frame {shown(camera)} to {shown(world)}"
            )
        notes.append(f"poses of {shown(camera)} in {shown(world)} from the transform tree")
        return lambda t: bag.tree.lookup(camera, world, t, gap)
    if not bag.pose_rows:
        return None
    stamps, rows = in_order(bag.pose_s, bag.pose_rows)
    T_body_cam = camera_in_body(options.T_cam_body, options.T_body_cam)
    if T_body_cam is None:
        T_body_cam = bag.tree.between(camera, bag.body) if bag.body and bag.body != camera else None
        if T_body_cam is None and bag.body != camera:
            notes.append(
                f"the poses of {bag.pose} are taken as those of the colour camera (OpenCV axes); if they are poses of "
                "a body, give --T-body-cam"
            )
    T_BC = torch.eye(4, dtype=torch.float64) if T_body_cam is None else T_body_cam
    return Trajectory(path=bag.pose, stamps_s=stamps, rows=rows, T_body_cam=T_BC, max_gap_s=gap).pose_at


_LARGE_BYTES = 1 << 20


class _BagPath(type(Path())):
    """A path whose file gives no more bytes than it has, also where a damaged bag asks for four gigabytes.

    Python's own files first take the memory that is asked for, and then see how much there is.
    """

    def open(self, mode: str = "r", *args: Any, **options: Any) -> Any:
        if mode != "rb":
            return super().open(mode, *args, **options)
        return _BagFile(open_regular(self, "a file of a ROS bag").detach())


class _BagFile(io.BufferedReader):
    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > _LARGE_BYTES:
            size = max(0, min(size, os.fstat(self.fileno()).st_size - self.tell()))
        return super().read(size)
