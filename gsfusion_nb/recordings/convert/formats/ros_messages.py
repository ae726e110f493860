"""Messages of ROS 1 and 2: images as arrays, and poses from the transform tree (tf, tf_static) or a topic."""

import struct
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ....checks import shown
from ....data.recorded.images import decode_image, decode_rgb
from ....data.recorded.poses import interpolate_rows, matrices
from ....data.sequence import BadFrameError, SequenceError
from ..recording import is_picture_file, metres

_CHANNELS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1}
_BAYER = {"bayer_rggb8": "BayerRG", "bayer_bggr8": "BayerBG", "bayer_gbrg8": "BayerGB", "bayer_grbg8": "BayerGR"}
_YUV = {"yuv422": "UYVY", "uyvy": "UYVY", "yuv422_yuy2": "YUY2", "yuyv": "YUY2"}
_MILLIMETRES = ("16UC1", "mono16")
_DEPTH_HEADER = struct.Struct("<iff")
_PNG = b"\x89PNG"


def colour_of(message: Any, source: str) -> tuple[np.ndarray, bytes]:
    """RGB uint8 [H, W, 3] of an Image or CompressedImage, and its JPEG or PNG bytes if it came as such.

    Raises:
        SequenceError: unknown encoding. BadFrameError: too few bytes, or a damaged image.
    """
    if hasattr(message, "format"):
        data = bytes(message.data)
        return decode_rgb(data, source), data if is_picture_file(data) else b""
    encoding = message.encoding
    if encoding in _BAYER:
        # OpenCV names the pattern by its second row and column
        swapped = {"BayerRG": "BayerBG", "BayerBG": "BayerRG", "BayerGB": "BayerGR", "BayerGR": "BayerGB"}
        code = getattr(cv2, f"COLOR_{swapped[_BAYER[encoding]]}2RGB")
        return cv2.cvtColor(_rows(message, 1, np.uint8, source)[..., 0], code), b""
    if encoding in _YUV:
        code = getattr(cv2, f"COLOR_YUV2RGB_{_YUV[encoding]}")
        return cv2.cvtColor(_rows(message, 2, np.uint8, source), code), b""
    if encoding not in _CHANNELS:
        known = ", ".join((*_CHANNELS, *_BAYER, *_YUV))
        raise SequenceError(
            f"{source} has the encoding {shown(encoding)}, which cannot be read as colour; known: {known}"
        )
    pixels = _rows(message, _CHANNELS[encoding], np.uint8, source)
    if encoding in ("bgr8", "bgra8", "8UC3"):
        pixels = pixels[..., 2::-1]
    return np.ascontiguousarray(np.repeat(pixels, 3, -1) if pixels.shape[-1] == 1 else pixels[..., :3]), b""


def depth_of(message: Any, source: str, scale: float = 0.0) -> np.ndarray:
    """Depth in metres, float32 [H, W], of 16UC1 (millimetres), 32FC1 (metres) or compressedDepth.

    Args:
        message: Image or CompressedImage.
        source: Its name, for messages.
        scale: Stored value of one metre where it differs from the standard (REP 118).
    """
    if hasattr(message, "format"):
        return _compressed_depth(bytes(message.data), message.format, source, scale)
    if message.encoding in _MILLIMETRES:
        return metres(_rows(message, 1, np.uint16, source)[..., 0], scale or 1000.0)
    if message.encoding == "32FC1":
        return metres(_rows(message, 1, np.float32, source)[..., 0], scale or 1.0)
    raise SequenceError(
        f"{source} has the encoding {shown(message.encoding)}; expected depth as {', '.join(_MILLIMETRES)} or 32FC1"
    )


def stores_millimetres(message: Any) -> bool:
    """The depth of this message is stored in whole millimetres."""
    return (message.format if hasattr(message, "format") else message.encoding).startswith(_MILLIMETRES)


def _compressed_depth(data: bytes, format: str, source: str, scale: float) -> np.ndarray:
    """A PNG, after a header of 12 bytes if compressed_depth_image_transport wrote it.

    Header: int32 kind, float32 a, float32 b. 16UC1 is stored as it is; a 32FC1 z as q = a / z + b, 0 = missing.
    """
    if "rvl" in format:
        raise SequenceError(
            f"{source} is packed as RVL ({shown(format)}); expected PNG: record or republish it uncompressed"
        )
    if data[:4] == _PNG:
        header, png = None, data
    elif len(data) > _DEPTH_HEADER.size and data[_DEPTH_HEADER.size :][:4] == _PNG:
        header, png = _DEPTH_HEADER.unpack_from(data), data[_DEPTH_HEADER.size :]
    else:
        raise BadFrameError(
            f"{source} holds no PNG after its header of 12 bytes ({shown(format)}); expected compressedDepth"
        )
    raw = decode_image(png, cv2.IMREAD_UNCHANGED, source, "depth")
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise BadFrameError(f"{source} must hold a 16-bit PNG of one channel, got {raw.dtype} {list(raw.shape)}")
    if header is None or not format.startswith("32FC1"):
        return metres(raw, scale or 1000.0)
    _, a, b = header
    quantised = raw.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        return metres(np.where(raw == 0, 0.0, a / (quantised - b)), scale or 1.0)


def _rows(message: Any, channels: int, dtype: type[np.generic], source: str) -> np.ndarray:
    """Pixels [H, W, C], without the padding at the ends of the rows, in this machine's byte order."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    kind = np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<")
    used = width * channels * kind.itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if step < used or data.size < step * height:
        raise BadFrameError(
            f"{source} is truncated: {data.size} bytes, rows of {step}; expected {height} rows of at least {used}"
        )
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :used])
    return rows.view(kind).astype(dtype, copy=False).reshape(height, width, channels)


POSE_TYPES = ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "Odometry")


@dataclass
class _Edge:
    """Transforms from a frame to its parent."""

    parent: str
    static: bool
    times_s: list[float] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)


class TransformTree:
    """Transforms between frames over time, as in tf."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._sorted: dict[str, tuple[Float[Tensor, " N"], Float[Tensor, "N 7"]]] = {}

    def add(self, message: Any, *, static: bool) -> None:
        """Add the transforms of a TFMessage."""
        for t in message.transforms:
            child, parent = (name.lstrip("/") for name in (t.child_frame_id, t.header.frame_id))
            edge = self._edges.setdefault(child, _Edge(parent, static))
            edge.times_s.append(seconds(t.header.stamp))
            edge.rows.append(_row(t.transform.translation, t.transform.rotation))
        self._sorted.clear()

    def root(self, frame: str) -> str:
        """The frame above ``frame`` that has no parent."""
        return self._chain(frame)[-1]

    def knows(self, frame: str, ancestor: str) -> bool:
        """Whether ``ancestor`` lies on the path from ``frame`` to the root."""
        return ancestor in self._chain(frame)

    def lookup(
        self, frame: str, ancestor: str, time_s: float = 0.0, max_gap_s: float = 0.0, *, fixed: bool = False
    ) -> Float[Tensor, "4 4"] | None:
        """Transform from ``frame`` to ``ancestor``; None where a moving one is unknown at that time, or where only
        ``fixed`` ones count. float64."""
        T = torch.eye(4, dtype=torch.float64)
        chain = self._chain(frame)
        for name in chain[: chain.index(ancestor)]:
            stamps, rows = self._rows(name)
            one = self._edges[name].static or len(rows) == 1
            row = rows[-1] if one else interpolate_rows(stamps, rows, time_s, max_gap_s=max_gap_s)
            if row is None or (fixed and not self._edges[name].static):
                return None
            T = matrices(row[None])[0] @ T
        return T

    def between(self, frame: str, other: str) -> Float[Tensor, "4 4"] | None:
        """Transform from ``frame`` to ``other`` through fixed transforms only, float64; or None."""
        common = next((f for f in self._chain(frame) if self.knows(other, f)), None)
        if common is None:
            return None
        up, down = (self.lookup(f, common, fixed=True) for f in (frame, other))
        return None if up is None or down is None else torch.linalg.inv(down) @ up

    def _chain(self, frame: str) -> list[str]:
        chain = [frame]
        while chain[-1] in self._edges and self._edges[chain[-1]].parent not in chain:
            chain.append(self._edges[chain[-1]].parent)
        return chain

    def _rows(self, name: str) -> tuple[Float[Tensor, " N"], Float[Tensor, "N 7"]]:
        if name not in self._sorted:
            edge = self._edges[name]
            self._sorted[name] = in_order(edge.times_s, edge.rows)
        return self._sorted[name]


def pose_rows(message: Any) -> tuple[list[float], str]:
    """``tx ty tz qx qy qz qw`` of a pose message, and the frame whose pose it is ("" where the message has none)."""
    if hasattr(message, "transform"):
        return _row(message.transform.translation, message.transform.rotation), message.child_frame_id.lstrip("/")
    pose = message.pose
    pose = pose.pose if hasattr(pose, "pose") else pose
    return _row(pose.position, pose.orientation), getattr(message, "child_frame_id", "").lstrip("/")


def in_order(times_s: list[float], rows: list[list[float]]) -> tuple[Float[Tensor, " N"], Float[Tensor, "N 7"]]:
    """Finite rows by increasing time, each time once (messages may arrive out of order). float64"""
    t, table = torch.tensor(times_s, dtype=torch.float64), torch.tensor(rows, dtype=torch.float64).reshape(-1, 7)
    usable = torch.isfinite(table).all(dim=1) & ((table[:, 3:].norm(dim=1) - 1).abs() < 1e-2)
    if not bool(usable.any()):
        raise SequenceError("every pose of the bag is NaN or has no unit quaternion; expected geometry_msgs poses")
    t, table = t[usable], table[usable]
    order = t.argsort(stable=True)
    t, table = t[order], table[order]
    first = torch.cat([torch.ones(1, dtype=torch.bool), t[1:] > t[:-1]])
    return t[first].contiguous(), table[first]


def seconds(stamp: Any) -> float:
    """Seconds of a ROS time."""
    return int(stamp.sec) + int(stamp.nanosec) * 1e-9


def _row(position: Any, rotation: Any) -> list[float]:
    return [position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w]
