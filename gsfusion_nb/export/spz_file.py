"""Reading ``.spz`` files (Niantic, versions 2 to 4): whole numbers, column by column, in one gzip stream (versions 2
and 3), or a Zstandard frame a column (version 4).

The columns: positions as 24-bit fixed-point numbers, opacities 0..255, colours, logarithms of the scales in sixteenths
from -10, rotations (version 2: x, y, z in a byte each; later: the three smallest parts in 10 bits each), coefficients
of the colours. Axes are right, up, back: a map is turned by 180 degrees about x, into the frame of PLY files (-y up).
"""

import importlib
import struct
import sys
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..files import SequenceError, read_bytes
from ..gaussians.rows import moved
from ..types import GaussianParams
from .packed_values import MAX_BYTES, params_of, quaternion_of_three

WHAT = "a .spz file of Gaussians"
_HEADER = struct.Struct("<4sIIBBBB")
_NGSP = struct.Struct("<4sIIBBBBI12x")
"""Of version 4: magic, version, number of Gaussians, degree, fractional bits, flags, number of streams, place of their
table."""
_ENTRY = struct.Struct("<QQ")
"""Of the table: bytes of a stream, packed and unpacked."""
ROTATION_BYTES = {2: 3, 3: 4, 4: 4}
_MOST_PACKED = 1032
"""deflate makes data at most this much smaller."""
MOST_BYTES = 4_000_000_000
"""Unpacked: 60 million Gaussians of degree 3."""


@dataclass(frozen=True, kw_only=True)
class SpzStreams:
    """The columns of a file as bytes, in their order."""

    version: int
    n: int
    degree: int
    fraction: int
    """Fractional bits of the positions."""
    columns: tuple[bytes, ...]


def widths(version: int, degree: int) -> list[int]:
    """Bytes of a Gaussian in each column: position, opacity, colour, scale, rotation, coefficients of the colour."""
    return [9, 1, 3, 3, ROTATION_BYTES[version], 3 * ((degree + 1) ** 2 - 1)]


def unpack(path: Path, data: bytes) -> SpzStreams:
    """The streams of a file's bytes.

    Raises:
        SequenceError: another kind of file, another version, or damaged.
    """
    return _zstandard(path, data) if data[:4] == b"NGSP" else _gzip(path, data)


def _gzip(path: Path, data: bytes) -> SpzStreams:
    unpacker = zlib.decompressobj(wbits=31)
    head = _inflated(unpacker, data, _HEADER.size, path)
    magic, version, n, degree, fraction, _, _ = _HEADER.unpack(head)
    if magic != b"NGSP" or version not in (2, 3) or degree > 3 or fraction > 23:
        raise SequenceError(
            f"{path} begins with {magic!r}, version {version}, degree {degree}; expected {WHAT}, version 2, 3 or 4"
        )
    sizes = [n * width for width in widths(version, degree)]
    _check_count(path, data, n, sum(sizes), sum(sizes) > _MOST_PACKED * len(data))
    body = _inflated(unpacker, unpacker.unconsumed_tail, sum(sizes), path)
    ends = [sum(sizes[: k + 1]) for k in range(len(sizes))]
    columns = tuple(body[end - size : end] for size, end in zip(sizes, ends, strict=True))
    return SpzStreams(version=version, n=n, degree=degree, fraction=fraction, columns=columns)


def _zstandard(path: Path, data: bytes) -> SpzStreams:
    if len(data) < _NGSP.size:
        raise SequenceError(f"{path} is truncated: it has {len(data)} bytes, less than a header; copy it again")
    _, version, n, degree, fraction, _, count, table = _NGSP.unpack_from(data)
    if version != 4 or degree > 3 or fraction > 23:
        raise SequenceError(
            f"{path} is a .spz file of version {version}, degree {degree}; expected version 2, 3 or 4, degree 0 to 3"
        )
    sizes = [n * width for width in widths(version, degree) if width]
    place = table + count * _ENTRY.size
    if count != len(sizes) or table < _NGSP.size or place > len(data):
        raise SequenceError(
            f"{path} says it has {count} streams, listed at byte {table}; expected {len(sizes)}; it is damaged"
        )
    _check_count(path, data, n, sum(sizes), sum(sizes) > MOST_BYTES)
    columns = []
    for k, size in enumerate(sizes):
        packed, unpacked = _ENTRY.unpack_from(data, table + k * _ENTRY.size)
        if unpacked != size or place + packed > len(data):
            raise SequenceError(
                f"{path}: stream {k + 1} of {count} has {packed} bytes for {unpacked}; expected {size} for {n} "
                "Gaussians and an end inside the file; it is truncated or damaged"
            )
        columns.append(_unzstd(data[place : place + packed], size, path))
        place += packed
    columns += [b""] * (6 - len(columns))  # degree 0 has no coefficients
    return SpzStreams(version=version, n=n, degree=degree, fraction=fraction, columns=tuple(columns))


def _check_count(path: Path, data: bytes, n: int, size: int, too_many: bool) -> None:
    if too_many:
        raise SequenceError(
            f"{path} says it has {n} Gaussians, {size} bytes, but its {len(data)} bytes are too few; it is damaged"
        )


def _inflated(unpacker: "zlib._Decompress", data: bytes, size: int, path: Path) -> bytes:
    """The next ``size`` bytes of the stream."""
    try:
        out = unpacker.decompress(data, size) if size else b""
    except zlib.error as e:
        raise SequenceError(f"{path} cannot be unpacked ({e}); expected {WHAT}") from None
    return _whole(out, size, path)


def _unzstd(data: bytes, size: int, path: Path) -> bytes:
    zstd: Any = importlib.import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
    try:
        out = zstd.ZstdDecompressor().decompress(data, max_length=size) if size else b""
    except (zstd.ZstdError, EOFError) as e:
        raise SequenceError(f"{path} cannot be unpacked ({e}); expected {WHAT}") from None
    return _whole(out, size, path)


def _whole(out: bytes, size: int, path: Path) -> bytes:
    if len(out) != size:
        raise SequenceError(f"{path} is truncated: {size - len(out)} bytes are missing after unpacking; copy it again")
    return out


_COLOUR_SCALE = 0.15
_TO_PLY = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))


def read_spz(path: str | Path) -> GaussianParams:
    """Read a ``.spz`` file of version 2, 3 or 4.

    Raises:
        FileNotFoundError: no such file. ValueError: another kind of file, another version, or damaged.
    """
    path = Path(path)
    found = unpack(path, read_bytes(path, WHAT, at_most=MAX_BYTES))
    n, K = found.n, (found.degree + 1) ** 2 - 1
    sizes = widths(found.version, found.degree)
    parts = [np.frombuffer(column, np.uint8) for column in found.columns]
    position, alpha, colour, scale, rotation, rest = (part.reshape(n, w) for part, w in zip(parts, sizes, strict=True))
    sh = np.concatenate([(colour / 255.0 - 0.5)[:, None] / _COLOUR_SCALE, rest.reshape(n, K, 3) / 128.0 - 1.0], axis=1)
    read = params_of(
        _fixed_point(position) / (1 << found.fraction),
        scale / 16.0 - 10.0,
        _wxyz(rotation, found.version),
        alpha[:, 0] / 255.0,
        sh,
    )
    return moved(read, _TO_PLY)


def _fixed_point(three_bytes: np.ndarray) -> np.ndarray:
    """Signed 24-bit numbers, little endian. [N, 9] -> [N, 3]"""
    b = three_bytes.reshape(-1, 3, 3).astype(np.int32)
    value = b[..., 0] | (b[..., 1] << 8) | (b[..., 2] << 16)
    return np.where(value >= 1 << 23, value - (1 << 24), value).astype(np.float64)


def _wxyz(rotation: np.ndarray, version: int) -> np.ndarray:
    if version == 2:
        xyz = rotation / 127.5 - 1.0
        w = np.sqrt(np.maximum(0.0, 1.0 - (xyz**2).sum(axis=1, keepdims=True)))
        return np.concatenate([w, xyz], axis=1)
    packed = rotation.copy().view("<u4")[:, 0]
    three = np.empty((len(packed), 3))
    for i in range(3):  # the last of the three is in the lowest bits: 9 bits of size, then the sign
        bits = packed >> np.uint32(10 * i)
        size = (bits & 511).astype(np.float64) / 511.0 * np.sqrt(0.5)
        three[:, 2 - i] = np.where((bits >> np.uint32(9)) & 1, -size, size)
    return quaternion_of_three(three, (packed >> np.uint32(30)).astype(np.int64))[:, [3, 0, 1, 2]]
