"""ROS 1 bags and ROS 2 bags (sqlite3, mcap), read with the pure-Python package ``rosbags``; no ROS
is needed.

Colour and depth are paired by the times in their headers; poses come from tf or a topic of poses,
interpolated at the depth image's time. Depth is 16UC1 in millimetres or 32FC1 in metres (REP 118),
pixel centres at integers, the image's frame has OpenCV axes (REP 103 "optical"). Recordings of the
RealSense SDK are such bags too (``realsense_sdk``).
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from ....checks import shown
from ....data.recorded.times import associate
from ....errors import SequenceError
from ..recording import ConvertOptions, RecordedFrame, Recording, RgbdImages
from .realsense_sdk import is_told_by_sdk, stream_of
from .ros_cameras import RosCalibration
from .ros_files import METADATA, message_of, opened_bag
from .ros_messages import colour_of, depth_of, stores_millimetres
from .ros_poses import PoseTopic, RosPoses
from .ros_tf import POSE_TYPES, seconds

MAX_TIME_DIFFERENCE_S = 0.02
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_SAYS_COLOUR = re.compile(r"rgb|colou?r", re.IGNORECASE)
_NO_COLOUR = re.compile(r"infra|/ir/|confidence", re.IGNORECASE)


@dataclass
class _Bag:
    """What the first pass over a bag collects: everything except the pixels."""

    path: Path
    calibration: RosCalibration
    colour: str = ""
    depth: str = ""
    colour_s: list[float] = field(default_factory=list)
    depth_s: list[float] = field(default_factory=list)
    poses: dict[str, PoseTopic] = field(default_factory=dict)
    millimetres: bool = True


LOOKS_FOR = "a .bag or .mcap file, or a folder with metadata.yaml"


def recognise(path: Path) -> bool:
    """A .bag or .mcap file, or the folder of a ROS 2 bag."""
    return (
        path.suffix in (".bag", ".mcap", ".db3") if path.is_file() else (path / METADATA).is_file()
    )


def read(path: Path, options: ConvertOptions) -> Recording:
    """Colour and depth of a bag (module docstring).

    Raises:
        SequenceError: the package ``rosbags`` is missing, the bag is damaged, a topic is missing or
            ambiguous (the message lists the candidates), no depth image has a colour image near in
            time, or the bag does not say how depth or poses belong to the colour camera.
    """
    bag = _first_pass(path, options)
    pairs = associate(bag.depth_s, bag.colour_s, max_difference_s=MAX_TIME_DIFFERENCE_S)
    if not pairs:
        raise SequenceError(
            f"{path}: none of {len(bag.depth_s)} images of {bag.depth} has an image of "
            f"{bag.colour} within {MAX_TIME_DIFFERENCE_S} s; expected the header stamps of both "
            "cameras to come from one clock"
        )
    cameras = bag.calibration.cameras(bag.colour, bag.depth, options)
    notes = [cameras.note]
    scale = options.depth_scale or _sdk_scale(bag, notes)
    pose_at, source_of_poses = RosPoses(
        path=path,
        camera=bag.calibration.frames.get(bag.colour, ""),
        times_s=bag.colour_s,
        tree=bag.calibration.tree,
        topics=bag.poses,
        options=options,
        notes=notes,
    ).find()

    def recorded_frames() -> Iterator[RecordedFrame]:
        for d, colour, depth in _second_pass(bag, pairs):
            time_s = seconds(colour.header.stamp)
            depth_time_s = bag.depth_s[d]
            # poses may have the stamps of depth
            if pose_at is not None and pose_at(time_s) is None:
                time_s = depth_time_s
            source = f"{path}: {bag.depth} image {d}"
            yield RecordedFrame(
                source=source,
                time_s=time_s,
                depth_time_s=depth_time_s,
                model=cameras.colour,
                depth_model=cameras.depth,
                T_colour_depth=cameras.T_colour_depth,
                T_WC=None if pose_at is None else pose_at(time_s),
                load=partial(_load, colour, depth, scale, source),
            )

    n_unpaired = len(bag.depth_s) - len(pairs)
    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(pairs),
        depth_scale=scale or (1000.0 if bag.millimetres else 1.0),
        has_poses=pose_at is not None,
        dropped={"no colour image near in time": n_unpaired} if n_unpaired else {},
        notes=(
            f"colour {bag.colour}, depth {bag.depth}, poses {source_of_poses or 'none'}",
            *notes,
        ),
    )


def _sdk_scale(bag: _Bag, notes: list[str]) -> float:
    """Stored depth of one metre in a recording of the RealSense SDK; 0 for the standard of ROS."""
    if not stream_of(bag.depth):
        return 0.0
    scale = bag.calibration.sdk.units_per_m(bag.depth, str(bag.path))
    if scale:
        notes.append(f"depth read as {scale:g} per metre, as Depth Units say")
    else:
        notes.append(
            "depth read as 1000 per metre, since the recording has no Depth Units (--depth-scale)"
        )
    return scale


def _load(colour: Any, depth: Any, scale: float, source: str) -> RgbdImages:
    rgb, encoded_rgb = colour_of(colour, f"{source} (colour)")
    return RgbdImages(rgb, depth_of(depth, source, scale), encoded_rgb)


def _first_pass(path: Path, options: ConvertOptions) -> _Bag:
    """Times, calibrations, transforms and poses; image messages are read but not kept."""
    bag = _Bag(path, RosCalibration(path))
    with opened_bag(path) as reader:
        types = {c.topic: c.msgtype for c in reader.connections}
        _choose_topics(bag, types, options)
        images = (bag.colour, bag.depth)
        connections = [
            c for c in reader.connections if c.topic in images or _is_told(c.topic, c.msgtype)
        ]
        for connection, _, raw in reader.messages(connections):
            _take(bag, connection, *message_of(reader, connection, raw))
    return bag


def _is_told(topic: str, kind: str) -> bool:
    """Whether messages of this topic and type say something about cameras or poses."""
    return kind.endswith(("/CameraInfo", *_POSES)) or _is_tf(kind) or is_told_by_sdk(topic)


_POSES = tuple(f"/{name}" for name in POSE_TYPES)


def _is_tf(kind: str) -> bool:
    return kind.lower().endswith("/tfmessage")  # tf2_msgs/TFMessage, and tf/tfMessage of older bags


def _take(bag: _Bag, connection: Any, message: Any, metres_per_unit: float) -> None:
    topic = connection.topic
    calibration = bag.calibration
    if topic in (bag.colour, bag.depth):
        if topic not in calibration.frames:
            calibration.frames[topic] = message.header.frame_id.lstrip("/")
            bag.millimetres = stores_millimetres(message) if topic == bag.depth else bag.millimetres
        calibration.sdk.add_units_of_image(topic, metres_per_unit)
        (bag.colour_s if topic == bag.colour else bag.depth_s).append(seconds(message.header.stamp))
    elif _is_tf(connection.msgtype):
        calibration.tree.add(message, static=topic.endswith("tf_static"))
    elif connection.msgtype.endswith("/CameraInfo"):
        calibration.info.setdefault(topic, message)
    elif is_told_by_sdk(topic):
        calibration.sdk.add(topic, message)
    else:
        bag.poses.setdefault(topic, PoseTopic()).add(message)


def _choose_topics(bag: _Bag, types: dict[str, str], options: ConvertOptions) -> None:
    images = [t for t, kind in types.items() if kind in _IMAGES]
    depth = [t for t in images if "depth" in t.lower()]
    aligned_topics = [t for t in depth if any(word in t for word in ("aligned", "registered"))]
    colour = [t for t in images if t not in depth and not _NO_COLOUR.search(t)]
    colour = [t for t in colour if _SAYS_COLOUR.search(t)] or colour
    bag.depth = _one(
        options.ros.depth_topic,
        aligned_topics or depth,
        images,
        "depth image",
        "--ros.depth-topic",
        bag.path,
    )
    bag.colour = _one(
        options.ros.colour_topic, colour, images, "colour image", "--ros.colour-topic", bag.path
    )


def _one(
    given_topic: str,
    candidates: list[str],
    all_topics: list[str],
    what: str,
    option: str,
    path: Path,
) -> str:
    """The requested topic, or the only candidate; where there is a raw and a compressed one, the
    raw one."""
    if given_topic:
        if given_topic not in all_topics:
            raise SequenceError(
                f"{path} has no {what} topic {shown(given_topic)}; it has "
                f"{', '.join(sorted(all_topics)) or 'none'}"
            )
        return given_topic
    raw = [t for t in candidates if not any(t != o and t.startswith(f"{o}/") for o in candidates)]
    if len(raw) == 1:
        return raw[0]
    topics_text = (
        ", ".join(sorted(candidates))
        or f"none among {', '.join(sorted(all_topics)) or 'no image topics at all'}"
    )
    raise SequenceError(
        f"{path} must have one {what} topic, found: {topics_text}; name one with {option}"
    )


def _second_pass(
    bag: _Bag,
    pairs: list[tuple[int, int]],
) -> Iterator[tuple[int, Any, Any]]:
    """Depth number and both messages of every pair, in the order in which pairs become complete in
    the bag.

    Only messages whose partner has not been read yet are kept: as many as one stream is behind the
    other.
    """
    partner = [{c: d for d, c in pairs}, {d: d for d, _ in pairs}]
    waiting: dict[int, tuple[int, Any]] = {}
    counts = [0, 0]
    with opened_bag(bag.path) as reader:
        connections = [c for c in reader.connections if c.topic in (bag.colour, bag.depth)]
        for connection, _, raw in reader.messages(connections):
            kind = 0 if connection.topic == bag.colour else 1
            d = partner[kind].get(counts[kind])
            counts[kind] += 1
            if d is None:
                continue
            message, _ = message_of(reader, connection, raw)
            other = waiting.pop(d, None)
            if other is None:
                waiting[d] = (kind, message)
                continue
            colour, depth = (message, other[1]) if kind == 0 else (other[1], message)
            yield d, colour, depth
