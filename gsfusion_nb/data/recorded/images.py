"""Decoding one colour or depth image, with errors that name the file. OpenCV is imported on first use."""

import functools
import logging
from pathlib import Path

import numpy as np

from ...foreign import IMAGE_BYTES, parsing, read_bytes
from ..sequence import BadFrameError, SequenceError, SequenceNotFoundError
from .image_header import EXR_MAGIC, exr_parts, image_size, is_to_be_turned, png_is_cut

log = logging.getLogger(__name__)

MAX_PIXELS = 40_000_000
"""More than any camera has; a small file can claim, and a decoder would allocate, a thousand times as many."""


MAX_EXR_NUMBERS = 2 * MAX_PIXELS
"""Of all channels of an OpenEXR file together, which are all unpacked."""


def read_rgb(path: Path) -> np.ndarray:
    """8-bit colour image as stored (EXIF orientation is ignored, because the intrinsics refer to the stored pixels).

    Grey images become colour, an alpha channel is dropped, 16-bit images are reduced to 8 bits.

    Returns:
        RGB, uint8. [H, W, 3]

    Raises:
        BadFrameError: the file is missing, truncated or not an image.
    """
    data = read_image_bytes(path, "colour")
    if is_to_be_turned(data):
        _tell_of_turned(path.parent)
    return decode_rgb(data, path)


@functools.cache
def _tell_of_turned(folder: Path) -> None:
    """Say once for a folder what is done with images that viewers show turned."""
    log.warning(
        "%s: images say (EXIF orientation) that they are to be shown turned; they are used as stored, as depth images "
        "and intrinsics are. If those belong to the turned images, turn the files first", folder
    )  # fmt: skip


def decode_rgb(data: bytes, source: Path | str) -> np.ndarray:
    """``read_rgb`` of an encoded image in memory; ``source`` is its name for messages."""
    import cv2

    bgr = decode_image(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, source, "colour")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def read_depth(path: Path, *, scale: float, invalid: tuple[int, ...] = ()) -> np.ndarray:
    """z-depth in metres from a 16-bit image.

    Args:
        path: Single-channel 16-bit image (PNG, TIFF or PGM).
        scale: Stored value of one metre.
        invalid: Stored values that mean "missing", besides 0.

    Returns:
        Depth in metres, 0 where missing, float32. [H, W]

    Raises:
        BadFrameError: the file is missing, truncated, not 16-bit single-channel, or holds no valid pixel.
    """
    import cv2

    raw = decode_image(read_image_bytes(path, "depth"), cv2.IMREAD_UNCHANGED, path, "depth")
    if raw.dtype != np.uint16 or raw.ndim != 2:
        channels = 1 if raw.ndim == 2 else raw.shape[2]
        raise BadFrameError(f"{path} must be a 16-bit depth image of one channel, got {raw.dtype} with {channels}")
    depth_m = raw.astype(np.float32)
    depth_m *= np.float32(1.0 / scale)
    for value in invalid:
        if value != 0:
            depth_m[raw == value] = 0.0
    if not depth_m.any():
        raise BadFrameError(
            f"{path} holds no valid depth: every pixel is {' or '.join(map(str, sorted({0, *invalid})))}"
        )
    return depth_m


def read_image_bytes(path: Path, kind: str) -> bytes:
    """Content of an image file. Raises ``BadFrameError`` when it is missing, unreadable, empty or far too large."""
    try:
        data = read_bytes(path, f"a {kind} image", at_most=IMAGE_BYTES)
    except SequenceNotFoundError:
        raise BadFrameError(f"{path} does not exist; expected the {kind} image of this frame") from None
    except SequenceError as e:
        raise BadFrameError(str(e)) from None
    if not data:
        raise BadFrameError(f"{path} is empty; expected a {kind} image")
    return data


def decode_image(data: bytes, flags: int, source: Path | str, kind: str) -> np.ndarray:
    """Pixels of an encoded image, as ``cv2.imdecode`` returns them. Raises ``BadFrameError`` naming ``source``."""
    import cv2

    if _jpeg_is_cut(data):
        raise BadFrameError(
            f"{source} is truncated; expected a whole {kind} image, but its end-of-image mark is missing"
        )
    check_image_size(data, source, kind)
    try:
        with parsing(source, f"a {kind} image", BadFrameError):
            image = None if png_is_cut(data) else cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except BadFrameError:
        image = None
    if image is None:
        raise BadFrameError(
            f"{source} cannot be decoded: it is truncated, damaged or not an image; expected a {kind} image"
        )
    return image


def check_image_size(data: bytes, source: Path | str, kind: str) -> None:
    """Raise ``BadFrameError`` before an image is decoded that is of no known kind or claims too many pixels."""
    size = image_size(data)
    if size is None:
        raise BadFrameError(
            f"{source} cannot be decoded: it is truncated, damaged or not an image; expected a {kind} image, as PNG, "
            "JPEG, TIFF, PNM or BMP"
        )
    width, height = size
    if width * height > MAX_PIXELS:
        raise BadFrameError(f"{source} claims {width}x{height} pixels; expected a {kind} image of at most 40 million")
    numbers = sum(w * h * channels for w, h, channels in exr_parts(data)) if data[:4] == EXR_MAGIC else 0
    if numbers > MAX_EXR_NUMBERS:
        raise BadFrameError(
            f"{source} claims {numbers} numbers in all its channels; expected a {kind} image of at most 80 million"
        )


def _jpeg_is_cut(data: bytes) -> bool:
    """A JPEG whose last scan has no end mark: some OpenCV versions fill the rest with grey instead of failing.

    Entropy-coded data never contain FF D9, but an embedded thumbnail does, so the positions are compared.
    """
    return data[:2] == b"\xff\xd8" and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
