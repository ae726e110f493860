"""Colour and depth images: their size by their header, whether they are complete, and decoding them.

OpenCV is imported on first use."""

import functools
import logging
import re
import struct
from pathlib import Path

import numpy as np

from ...foreign import IMAGE_BYTES, open_regular, parsing, read_bytes
from ..sequence import BadFrameError, SequenceError, SequenceNotFoundError

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


_END_MARKS = {b"\x89PNG\r\n\x1a\n": b"IEND\xaeB`\x82", b"\xff\xd8": b"\xff\xd9"}
"""First bytes of PNG and JPEG files, and the mark that ends them (PNG, W3C 2003, 11.2.5; JPEG, ITU-T T.81, B.1.1.3)."""

_TAIL_BYTES = 64
"""Some programs write a few bytes after the mark."""


def is_complete_image(path: Path) -> bool:
    """False for a missing or empty file, and for a PNG or JPEG without its end mark.

    Decoders fill the missing part of such a file with grey or black instead of failing. For other formats only the
    beginning is checked.
    """
    try:
        with open_regular(path, "an image") as file:
            head = file.read(8)
            size = file.seek(0, 2)
            file.seek(max(0, size - _TAIL_BYTES))
            tail = file.read()
    except (OSError, SequenceError):
        return False
    for first, last in _END_MARKS.items():
        if head.startswith(first):
            return last in tail
    return len(head) == 8


EXR_MAGIC = b"v/1\x01"
_JPEG_SIZES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
"""Markers of a frame header (ITU-T T.81, table B.1)."""
_TIFF_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
_PNM = re.compile(rb"P[1-6](?:\s|#[^\n]*\n)+(\d+)(?:\s|#[^\n]*\n)+(\d+)\s")


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that a PNG, JPEG, TIFF, PNM, BMP or OpenEXR file claims; None for any other data."""
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return struct.unpack_from(">II", data, 16) if len(data) >= 24 else None
    if data[:2] == b"\xff\xd8":
        return _jpeg(data)
    if data[:4] in (b"II*\0", b"II+\0", b"MM\0*", b"MM\0+"):
        return _tiff(data)
    if data[:2] == b"BM":
        if len(data) < 26:
            return None
        width, height = struct.unpack_from("<ii", data, 18)  # the height is negative where the first row is the top one
        return abs(width), abs(height)
    if data[:4] == EXR_MAGIC:
        return _exr(data)
    match = _PNM.match(data[:4096])
    return (int(match[1]), int(match[2])) if match else None


def png_is_cut(data: bytes) -> bool:
    """A PNG with a chunk that is longer than what is left of the file: OpenCV 5 would ask for that much memory."""
    at = 8
    while data[:8] == b"\x89PNG\r\n\x1a\n" and at + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        at += 12 + length
        if at > len(data):
            return True
        if kind == b"IEND":
            break
    return False


def _jpeg(data: bytes) -> tuple[int, int] | None:
    """The largest of the frame headers: an embedded thumbnail is inside another segment, which is stepped over."""
    at, found = 2, None
    while at + 4 <= len(data):
        if data[at] != 0xFF:  # decoders skip such bytes
            at = data.find(b"\xff", at)
            if at < 0:
                break
            continue
        marker = data[at + 1]
        if marker in (0x00, 0x01, 0xFF) or 0xD0 <= marker <= 0xD9:
            at += 1 if marker == 0xFF else 2
            continue
        if marker in _JPEG_SIZES and at + 9 <= len(data):
            height, width = struct.unpack_from(">HH", data, at + 5)
            found = (max(width, found[0] if found else 0), max(height, found[1] if found else 0))
        if marker == 0xDA:
            break
        at += 2 + max(2, int.from_bytes(data[at + 2 : at + 4], "big"))
    return found


def _exr(data: bytes) -> tuple[int, int] | None:
    """The data window, whose corners are both inside the picture; of several parts the largest."""
    parts = exr_parts(data)
    if not parts:
        return None
    return max(width for width, _, _ in parts), max(height for _, height, _ in parts)


def exr_parts(data: bytes) -> list[tuple[int, int, int]]:
    """Width, height and number of channels of each part of an OpenEXR file; empty if the header is damaged.

    Source: "OpenEXR File Layout": attributes of name, type, size and value; an empty name ends the header of a part,
    and an empty header the list of parts of a file whose version has bit 12 set.
    """
    if len(data) < 8:
        return []
    several, at, parts = bool(struct.unpack_from("<I", data, 4)[0] & 0x1000), 8, []
    while True:
        part, at = _exr_part(data, at)
        if part is None:
            return parts if several and at > 0 else []
        parts.append(part)
        if not several:
            return parts


def _exr_part(data: bytes, at: int) -> tuple[tuple[int, int, int] | None, int]:
    """Width, height and channels of the header at ``at``, and where it ends; at -1 if it is damaged."""
    values: dict[bytes, bytes] = {}
    try:
        while data[at]:
            name, kind, at = _exr_text(data, at)
            (size,) = struct.unpack_from("<i", data, at)
            if not 0 <= size <= len(data) - at - 4:
                return None, -1
            values[name + b" " + kind] = data[at + 4 : at + 4 + size]
            at += 4 + size
        if not values:
            return None, at + 1
        left, top, right, bottom = struct.unpack("<iiii", values[b"dataWindow box2i"])
        channels, n, place = values[b"channels chlist"], 0, 0
        while channels[place]:  # a name, then the type, a flag with 3 spare bytes, and two steps of sampling
            place = channels.index(b"\0", place) + 17
            n += 1
    except (struct.error, ValueError, IndexError, KeyError):
        return None, -1
    return (right - left + 1, bottom - top + 1, n), at + 1


def _exr_text(data: bytes, at: int) -> tuple[bytes, bytes, int]:
    """Two texts that end in a zero byte, and where the second ends."""
    middle = data.index(b"\0", at)
    end = data.index(b"\0", middle + 1)
    return data[at:middle], data[middle + 1 : end], end + 1


def is_to_be_turned(data: bytes) -> bool:
    """Whether a JPEG says (EXIF, tag 274) that viewers are to show it turned or mirrored."""
    at = data.find(b"Exif\0\0", 0, 1 << 16) if data[:2] == b"\xff\xd8" else -1
    return at >= 0 and _tiff_tags(data[at + 6 : at + (1 << 16)], (274,)).get(274, 1) in range(2, 9)


def _tiff(data: bytes) -> tuple[int, int] | None:
    size = _tiff_tags(data, (256, 257))
    return (size[256], size[257]) if len(size) == 2 else None


def _tiff_tags(data: bytes, tags: tuple[int, ...]) -> dict[int, int]:
    """Numbers in the first directory (TIFF 6.0, section 2; version 43 has 8-byte places), as far as it has them."""
    order, big = ("<" if data[:2] == b"II" else ">"), data[2:4] in (b"+\0", b"\0+")
    found: dict[int, int] = {}
    place, count, entry, value_at = ("Q", "Q", 20, 12) if big else ("I", "H", 12, 8)
    try:
        (at,) = struct.unpack_from(order + place, data, 8 if big else 4)
        (n,) = struct.unpack_from(order + count, data, at)
        at += struct.calcsize(order + count)
        for i in range(min(n, 1000)):
            tag, kind = struct.unpack_from(order + "HH", data, at + i * entry)
            if tag in tags and kind in _TIFF_TYPES:
                (found[tag],) = struct.unpack_from(order + _TIFF_TYPES[kind], data, at + i * entry + value_at)
    except struct.error:
        return {}
    return found
