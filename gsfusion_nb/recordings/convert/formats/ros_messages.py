"""Image messages of ROS 1 and 2 as arrays."""

import struct
from typing import Any

import cv2
import numpy as np

from ....checks import shown
from ....data.recorded.images import decode_image, decode_rgb
from ....errors import BadFrameError, SequenceError
from ..depth_files import metres
from ..recording import is_picture_file

_CHANNELS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1}
_BAYER = {
    "bayer_rggb8": "BayerRG",
    "bayer_bggr8": "BayerBG",
    "bayer_gbrg8": "BayerGB",
    "bayer_grbg8": "BayerGR",
}
_YUV = {"yuv422": "UYVY", "uyvy": "UYVY", "yuv422_yuy2": "YUY2", "yuyv": "YUY2"}
_MILLIMETRES = ("16UC1", "mono16")
_DEPTH_HEADER = struct.Struct("<iff")
_PNG = b"\x89PNG"


def colour_of(message: Any, source: str) -> tuple[np.ndarray, bytes]:
    """RGB uint8 [H, W, 3] of an Image or CompressedImage, and its JPEG or PNG bytes if it came as
    such.

    Raises:
        SequenceError: unknown encoding. BadFrameError: too few bytes, or a damaged image.
    """
    if hasattr(message, "format"):
        data = bytes(message.data)
        return decode_rgb(data, source), data if is_picture_file(data) else b""
    encoding = message.encoding
    if encoding in _BAYER:
        # OpenCV names the pattern by its second row and column
        channel_order = {
            "BayerRG": "BayerBG",
            "BayerBG": "BayerRG",
            "BayerGB": "BayerGR",
            "BayerGR": "BayerGB",
        }
        code = getattr(cv2, f"COLOR_{channel_order[_BAYER[encoding]]}2RGB")
        return cv2.cvtColor(_rows(message, 1, np.uint8, source)[..., 0], code), b""
    if encoding.lower() in _YUV:  # the RealSense SDK writes YUYV
        code = getattr(cv2, f"COLOR_YUV2RGB_{_YUV[encoding.lower()]}")
        return cv2.cvtColor(_rows(message, 2, np.uint8, source), code), b""
    if encoding not in _CHANNELS:
        encodings_text = ", ".join((*_CHANNELS, *_BAYER, *_YUV))
        raise SequenceError(
            f"{source} has the encoding {shown(encoding)}, which cannot be read as colour; known: "
            f"{encodings_text}"
        )
    pixels = _rows(message, _CHANNELS[encoding], np.uint8, source)
    if encoding in ("bgr8", "bgra8", "8UC3"):
        pixels = pixels[..., 2::-1]
    return np.ascontiguousarray(
        np.repeat(pixels, 3, -1) if pixels.shape[-1] == 1 else pixels[..., :3]
    ), b""


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
        f"{source} has the encoding {shown(message.encoding)}; expected depth as "
        f"{', '.join(_MILLIMETRES)} or 32FC1"
    )


def stores_millimetres(message: Any) -> bool:
    """The depth of this message is stored in whole millimetres."""
    return (message.format if hasattr(message, "format") else message.encoding).startswith(
        _MILLIMETRES
    )


def _compressed_depth(data: bytes, format: str, source: str, scale: float) -> np.ndarray:
    """A PNG, after a header of 12 bytes if compressed_depth_image_transport wrote it.

    Header: int32 kind, float32 a, float32 b. 16UC1 is stored as it is; a 32FC1 z as q = a / z + b,
    0 = missing.
    """
    if "rvl" in format:
        raise SequenceError(
            f"{source} is packed as RVL ({shown(format)}); expected PNG: record or republish it "
            "uncompressed"
        )
    if data[:4] == _PNG:
        header = None
        png = data
    elif len(data) > _DEPTH_HEADER.size and data[_DEPTH_HEADER.size :][:4] == _PNG:
        header = _DEPTH_HEADER.unpack_from(data)
        png = data[_DEPTH_HEADER.size :]
    else:
        raise BadFrameError(
            f"{source} holds no PNG after its header of 12 bytes ({shown(format)}); expected "
            "compressedDepth"
        )
    raw = decode_image(png, cv2.IMREAD_UNCHANGED, source, "depth")
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise BadFrameError(
            f"{source} must hold a 16-bit PNG of one channel, got {raw.dtype} {list(raw.shape)}"
        )
    if header is None or not format.startswith("32FC1"):
        return metres(raw, scale or 1000.0)
    _, a, b = header
    inverse_codes = raw.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        return metres(
            np.where(raw == 0, 0.0, a / (inverse_codes - b)),
            scale or 1.0,
        )


def _rows(
    message: Any,
    channels: int,
    dtype: type[np.generic],
    source: str,
) -> np.ndarray:
    """Pixels [H, W, C], without the padding at the ends of the rows, in this machine's byte
    order."""
    height = int(message.height)
    width = int(message.width)
    step = int(message.step)
    kind = np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<")
    used = width * channels * kind.itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if step < used or data.size < step * height:
        raise BadFrameError(
            f"{source} is truncated: {data.size} bytes, rows of {step}; expected {height} rows of "
            f"at least {used}"
        )
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :used])
    return rows.view(kind).astype(dtype, copy=False).reshape(height, width, channels)
