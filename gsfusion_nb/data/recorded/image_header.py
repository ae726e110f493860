"""The size of an encoded image, read from its header: known before a decoder asks for memory."""

import re
import struct

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
