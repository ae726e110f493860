"""Colour and depth images: their size by their header, whether they are complete, and decoding
them.

OpenCV is imported on first use."""

import functools
import io
import logging
import re
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ...errors import BadFrameError, SequenceError, SequenceNotFoundError
from ...files import IMAGE_BYTES, parsing, read_bytes

log = logging.getLogger(__name__)

MAX_PIXELS = 40_000_000
"""More than any camera has; a small file can claim, and a decoder would allocate, a thousand times
as many."""
LOST_PRECISION = (
    "precision was lost when this was written; export depth again as 16-bit PNG in "
    "millimetres, or in floating point"
)
_EXR_WINDOW = re.compile(rb"dataWindow\0box2i\0\x10\0\0\0(.{16})", re.DOTALL)
"""Left, top, right and bottom pixel of a part of an OpenEXR file, all inside ("OpenEXR File
Layout")."""


def read_rgb(path: Path, *, bits: int = 16) -> np.ndarray:
    """8-bit colour image as stored (EXIF orientation is ignored, because the intrinsics refer to
    the stored pixels).

    Grey images become colour, an alpha channel is dropped, 16-bit images are reduced to 8 bits.

    Args:
        path: The file.
        bits: How many of its lowest bits an image of 16 bits uses, 8 to 16: 12 for a camera of 12
            bits whose values were stored as they are.

    Returns:
        RGB, uint8. [H, W, 3]

    Raises:
        BadFrameError: the file is missing, truncated, not an image, or uses more bits.
    """
    data = read_image_bytes(path, "colour")
    if is_to_be_turned(data):
        _tell_of_turned(path.parent)
    return decode_rgb(data, path, bits=bits)


@functools.cache
def _tell_of_turned(folder: Path) -> None:
    """Say once for a folder what is done with images that viewers show turned."""
    log.warning(
        "%s: images say (EXIF orientation) that they are to be shown turned; they are used as "
        "stored, as depth images "
        "and intrinsics are. If those belong to the turned images, turn the files first",
        folder,
    )


_DARKEST_OF_16_BITS = 16
"""Of 256: an image of 16 bits that is nowhere brighter uses 12 bits or fewer."""


_OF_16_BITS = (b"II*\0", b"MM\0*", b"P5", b"P6")
"""How files begin, besides PNG, that may hold 16 bits: TIFF and PNM."""


def _has_16_bits(data: bytes, source: Path | str) -> bool:
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return data[24:25] == b"\x10"
    if not data.startswith(_OF_16_BITS):
        return False
    return decode_image(data, _STORED_COLOUR | cv2.IMREAD_ANYDEPTH, source, "colour").itemsize == 2


@functools.cache
def _tell_of_dark(folder: Path) -> None:
    """Say once for a folder that its images of 16 bits may be of a camera with fewer."""
    log.warning(
        "%s: colour images of 16 bits use 12 or fewer of them, and are taken as they are; if the "
        "camera has 12 bits, they are 16 times too dark: --reader colour_bits=12 (plain layout), "
        "or gsfusion-nb convert --colour-bits 12",
        folder,
    )


_STORED_COLOUR = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


def decode_rgb(data: bytes, source: Path | str, *, bits: int = 16) -> np.ndarray:
    """``read_rgb`` of an encoded image in memory; ``source`` is its name for messages."""
    if bits < 16 and _has_16_bits(data, source):
        deep = decode_image(data, _STORED_COLOUR | cv2.IMREAD_ANYDEPTH, source, "colour")
        return cv2.cvtColor(_upper_8_bits(deep, bits, source), cv2.COLOR_BGR2RGB)
    bgr = decode_image(data, _STORED_COLOUR, source, "colour")
    if bits == 16 and 0 < bgr.max() < _DARKEST_OF_16_BITS and _has_16_bits(data, source):
        _tell_of_dark(Path(source).parent)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def _upper_8_bits(image: np.ndarray, bits: int, source: Path | str) -> np.ndarray:
    """The upper 8 of the lowest ``bits`` bits. Raises ``BadFrameError`` if a value has more."""
    largest = int(image.max())
    if largest >= 1 << bits:
        raise BadFrameError(
            f"{source} holds the value {largest}, and colour of {bits} bits is at most "
            f"{(1 << bits) - 1}; expected colour_bits of {largest.bit_length()} or more"
        )
    return (image >> (bits - 8)).astype(np.uint8)


def read_depth(
    path: Path,
    *,
    scale: float,
    invalid: tuple[int, ...] = (),
) -> np.ndarray:
    """z-depth in metres from a 16-bit image.

    Args:
        path: Single-channel 16-bit image (PNG, TIFF or PGM).
        scale: Stored value of one metre.
        invalid: Stored values that mean "missing", besides 0.

    Returns:
        Depth in metres, 0 where missing, float32. [H, W]

    Raises:
        BadFrameError: the file is missing, truncated, not 16-bit single-channel, or holds no valid
            pixel.
    """
    raw = decode_depth(path, (np.uint16,))
    depth_m = raw.astype(np.float32)
    depth_m *= np.float32(1.0 / scale)
    for value in invalid:
        if value != 0:
            depth_m[raw == value] = 0.0
    if not depth_m.any():
        raise BadFrameError(
            f"{path} holds no valid depth: every pixel is "
            f"{' or '.join(map(str, sorted({0, *invalid})))}"
        )
    return depth_m


def decode_depth(path: Path, types: tuple[Any, ...]) -> np.ndarray:
    """Stored values of a depth image. Raises ``BadFrameError`` unless it has one channel and one of
    these types."""
    raw = decode_image(read_image_bytes(path, "depth"), cv2.IMREAD_UNCHANGED, path, "depth")
    if raw.dtype == np.uint8 and raw.ndim == 3:
        raise BadFrameError(
            f"{path} is a colour image of {raw.shape[2]} channels with 8 bits; expected depth of "
            "one channel; unpack depth first that is packed into the channels (CARLA, RLBench)"
        )
    if raw.dtype == np.uint8:
        raise BadFrameError(f"{path} holds depth in 8 bits, so {LOST_PRECISION}")
    if raw.ndim != 2 or raw.dtype not in types:
        types_text = "16-bit" if types == (np.uint16,) else "16-bit or floating-point"
        raise BadFrameError(
            f"{path} must be a {types_text} depth image of one channel, got {raw.dtype} "
            f"{list(raw.shape)}"
        )
    return raw


def read_image_bytes(path: Path, kind: str) -> bytes:
    """Content of an image file. Raises ``BadFrameError`` when it is missing, unreadable, empty or
    far too large."""
    try:
        data = read_bytes(path, f"a {kind} image", at_most=IMAGE_BYTES)
    except SequenceNotFoundError:
        raise BadFrameError(
            f"{path} does not exist; expected the {kind} image of this frame"
        ) from None
    except SequenceError as e:
        raise BadFrameError(str(e)) from None
    if not data:
        raise BadFrameError(f"{path} is empty; expected a {kind} image")
    return data


def decode_image(
    data: bytes,
    flags: int,
    source: Path | str,
    kind: str,
) -> np.ndarray:
    """Pixels of an encoded image, as ``cv2.imdecode`` returns them. Raises ``BadFrameError`` naming
    ``source``."""
    if _is_cut(data):
        raise BadFrameError(
            f"{source} is truncated; expected a whole {kind} image, but its end mark is missing"
        )
    check_image_size(data, source, kind)
    try:
        with parsing(source, f"a {kind} image", BadFrameError):
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except BadFrameError:
        image = None
    if image is None:
        raise BadFrameError(
            f"{source} cannot be decoded: it is truncated, damaged or not an image; expected a "
            f"{kind} image"
        )
    return image


def check_image_size(data: bytes, source: Path | str, kind: str) -> None:
    """Raise ``BadFrameError`` before an image is decoded that is of no known kind or claims too
    many pixels."""
    size = image_size(data)
    if size is None:
        raise BadFrameError(
            f"{source} cannot be decoded: it is truncated, damaged or not an image, or claims far "
            f"too many pixels; expected a {kind} image, as PNG, JPEG, TIFF, PNM, BMP or WebP"
        )
    width, height = size
    if width * height > MAX_PIXELS:
        raise BadFrameError(
            f"{source} claims {width}x{height} pixels; expected a {kind} image of at most 40 "
            "million"
        )


def _is_cut(data: bytes) -> bool:
    """A PNG or JPEG without the mark that ends it: decoders fill the missing part with grey or
    black and do not fail.

    Entropy-coded data of a JPEG never contain FF D9, but an embedded thumbnail does, so the mark
    must come after the last scan (PNG, W3C 2003, 11.2.5; JPEG, ITU-T T.81, B.1.1.3).
    """
    if data[:2] == b"\xff\xd8":
        return data.rfind(b"\xff\xd9") <= data.rfind(b"\xff\xda")
    return data[:8] == b"\x89PNG\r\n\x1a\n" and b"IEND\xaeB`\x82" not in data


def is_complete_image(path: Path) -> bool:
    """False for a missing or empty file, and for a PNG or JPEG without its end mark."""
    try:
        data = read_image_bytes(path, "whole")
    except BadFrameError:
        return False
    return len(data) >= 8 and not _is_cut(data)


def is_to_be_turned(data: bytes) -> bool:
    """Whether a JPEG says (EXIF, tag 274) that viewers are to show it turned or mirrored."""
    from PIL import Image

    try:
        orientation = b"Exif\0\0" in data[: 1 << 16] and Image.open(
            io.BytesIO(data), formats=("JPEG",)
        ).getexif().get(274, 1)
        return orientation in range(2, 9)
    except Exception:  # whatever follows from damaged tags
        return False


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that the header of a PNG, JPEG, TIFF, PNM, BMP, WebP or OpenEXR file claims;
    None for others."""
    if data[:4] == b"v/1\x01":
        header = data[: 1 << 20]
        windows = [struct.unpack("<iiii", window) for window in _EXR_WINDOW.findall(header)]
        sizes = [(right - x0 + 1, bottom - top + 1) for x0, top, right, bottom in windows]
        return max(sizes, key=lambda size: size[0] * size[1], default=None)
    from PIL import Image

    try:
        return Image.open(
            io.BytesIO(data), formats=("PNG", "JPEG", "TIFF", "PPM", "BMP", "WEBP")
        ).size
    except Exception:  # a damaged header leads to any exception
        return None
