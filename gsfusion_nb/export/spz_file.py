"""Reading ``.spz`` files (Niantic, versions 2 and 3): a gzip stream of whole numbers, column by column.

Header of 16 bytes: "NGSP", version, number of Gaussians, degree of the colours, fractional bits of the positions,
flags. Then all positions as 24-bit fixed-point numbers, opacities 0..255, colours, logarithms of the scales in
sixteenths from -10, rotations (version 2: x, y, z in a byte each; version 3: the three smallest parts in 10 bits each),
coefficients of the colours. Axes are right, up, back: a map is turned by 180 degrees about x, into the frame of PLY
files (-y up).
"""

import struct
import zlib
from pathlib import Path

import numpy as np
import torch

from ..errors import SequenceError
from ..foreign import read_bytes
from ..gaussians.moved import moved
from ..types import GaussianParams
from .packed_values import params_of, quaternion_of_three
from .splat_file import MAX_BYTES

WHAT = "a .spz file of Gaussians"
_HEADER = struct.Struct("<4sIIBBBB")
_ROTATION_BYTES = {2: 3, 3: 4}
_MOST_PACKED = 1032
"""deflate makes data at most this much smaller."""
_COLOUR_SCALE = 0.15
_TO_PLY = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))


def read_spz(path: str | Path) -> GaussianParams:
    """Read a ``.spz`` file of version 2 or 3.

    Raises:
        FileNotFoundError: no such file. ValueError: another kind of file, another version, or damaged.
    """
    path = Path(path)
    data = read_bytes(path, WHAT, at_most=MAX_BYTES)
    if data[:4] == b"NGSP":
        version = struct.unpack_from("<I", data.ljust(8, b"\0"), 4)[0]
        raise SequenceError(
            f"{path} is a .spz file of version {version}, which packs with Zstandard; expected version 2 or 3: "
            "convert it with  npx @playcanvas/splat-transform IN.spz OUT.ply"
        )
    unpacker = zlib.decompressobj(wbits=31)
    head = _unpacked(unpacker, data, _HEADER.size, path)
    magic, version, n, degree, fraction, _, _ = _HEADER.unpack(head)
    if magic != b"NGSP" or version not in _ROTATION_BYTES or degree > 3 or fraction > 23:
        raise SequenceError(
            f"{path} begins with {magic!r}, version {version}, degree {degree}; expected {WHAT}, version 2 or 3"
        )
    K = (degree + 1) ** 2 - 1
    widths = [9, 1, 3, 3, _ROTATION_BYTES[version], 3 * K]
    if n * sum(widths) > _MOST_PACKED * len(data):
        raise SequenceError(f"{path} says it has {n} Gaussians, but its {len(data)} bytes are too few; it is damaged")
    body = _unpacked(unpacker, unpacker.unconsumed_tail, n * sum(widths), path)
    parts = np.split(np.frombuffer(body, np.uint8), np.cumsum([n * w for w in widths])[:-1])
    position, alpha, colour, scale, rotation, rest = (part.reshape(n, w) for part, w in zip(parts, widths, strict=True))
    sh = np.concatenate([(colour / 255.0 - 0.5)[:, None] / _COLOUR_SCALE, rest.reshape(n, K, 3) / 128.0 - 1.0], axis=1)
    read = params_of(
        _fixed_point(position) / (1 << fraction), scale / 16.0 - 10.0, _wxyz(rotation, version), alpha[:, 0] / 255.0, sh
    )
    return moved(read, _TO_PLY)


def _unpacked(unpacker: "zlib._Decompress", data: bytes, size: int, path: Path) -> bytes:
    """The next ``size`` bytes of the stream."""
    try:
        out = unpacker.decompress(data, size) if size else b""
    except zlib.error as e:
        raise SequenceError(f"{path} cannot be unpacked ({e}); expected {WHAT}") from None
    if len(out) != size:
        raise SequenceError(f"{path} is truncated: {size - len(out)} bytes are missing after unpacking; copy it again")
    return out


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
