"""Decoding colour and depth images of common formats, from files or from bytes inside a container."""

import io
import math
from pathlib import Path

import numpy as np

from ...data.recorded.images import check_image_size, decode_image, decode_rgb, read_image_bytes
from ...data.sequence import BadFrameError, SequenceError
from ...foreign import is_file, parsing
from .recording import RgbdImages

DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".pgm", ".npy", ".exr")


def decode_depth(data: bytes, source: str, scale: float) -> np.ndarray:
    """Depth in metres of a one-channel image of 16-bit or float numbers, 0 = missing, float32. [H, W]

    Args:
        data: PNG, TIFF or PGM.
        source: Its name, for messages.
        scale: Stored value of one metre.
    """
    import cv2

    raw = decode_image(data, cv2.IMREAD_UNCHANGED, source, "depth")
    if raw.ndim != 2 or raw.dtype not in (np.uint16, np.float32, np.float64):
        channels = 1 if raw.ndim == 2 else raw.shape[2]
        raise BadFrameError(
            f"{source} must be a depth image of one channel, 16-bit or float, got {raw.dtype} with {channels}"
        )
    return metres(raw, scale)


def read_depth_file(path: Path, scale: float) -> np.ndarray:
    """Depth in metres of a PNG, TIFF, PGM, NumPy or OpenEXR file, 0 = missing, float32. [H, W]"""
    if path.suffix.lower() == ".npy":
        return metres(_numpy_array(path), scale)
    if path.suffix.lower() == ".exr":
        return metres(_exr_channel(path), scale)
    return decode_depth(read_image_bytes(path, "depth"), str(path), scale)


def metres(raw: np.ndarray, scale: float) -> np.ndarray:
    """Stored depth as metres; NaN, infinities and negative values become 0 (missing), float32."""
    depth_m = raw.astype(np.float32) * np.float32(1.0 / scale)
    depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0.0
    return depth_m


def load_pair(colour: Path, depth: Path, scale: float) -> RgbdImages:
    """Colour and depth of two files. Raises ``BadFrameError`` naming the one that cannot be used."""
    return with_colour(read_image_bytes(colour, "colour"), str(colour), read_depth_file(depth, scale))


def with_colour(data: bytes, source: str, depth_m: np.ndarray) -> RgbdImages:
    """An encoded colour image, decoded, and depth in metres."""
    return RgbdImages(decode_rgb(data, source), depth_m, data if is_picture_file(data) else b"")


def is_picture_file(data: bytes) -> bool:
    """Whether these bytes are a JPEG or PNG file, which can be written unchanged."""
    return data[:2] == b"\xff\xd8" or data[:8] == b"\x89PNG\r\n\x1a\n"


def find_depth(folder: Path, stem: str) -> Path:
    """Depth file of the colour image ``stem``: the same name with any known suffix. The file may be missing."""
    found = (folder / f"{stem}{s}" for s in DEPTH_SUFFIXES)
    return next((p for p in found if is_file(p)), folder / f"{stem}.png")


def _numpy_array(path: Path) -> np.ndarray:
    what = "a NumPy array of depth"
    data = io.BytesIO(read_image_bytes(path, "depth"))
    with parsing(path, what, BadFrameError):
        version = np.lib.format.read_magic(data)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(data, max_header_size=10_000)
        if dtype.itemsize * math.prod(shape) > len(data.getbuffer()):
            raise BadFrameError(f"{path} claims an array {list(shape)} of {dtype}, more than it holds; expected {what}")
        data.seek(0)
        array = np.squeeze(np.load(data, allow_pickle=False))
    if array.ndim != 2 or array.dtype.kind not in "fu":
        raise BadFrameError(f"{path} must hold a depth image [H, W], got {array.dtype} {list(array.shape)}")
    return array


def _exr_channel(path: Path) -> np.ndarray:
    try:
        import OpenEXR  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise SequenceError(
            f"{path} is an OpenEXR file, which needs the package OpenEXR: pip install OpenEXR"
        ) from None
    check_image_size(read_image_bytes(path, "depth"), path, "depth")
    with parsing(path, "depth as OpenEXR", BadFrameError), OpenEXR.File(str(path)) as file:
        channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    array = next((channels[n] for n in ("Z", "Y", "R", "RGB", "RGBA") if n in channels), None)
    if array is None:
        raise BadFrameError(f"{path} has the channels {', '.join(channels)}; expected depth in Z, Y or R")
    return array if array.ndim == 2 else array[..., 0]
