"""Reading ``.spz`` files (Niantic, versions 2 to 4): whole numbers, column by column, packed (``spz_streams``).

The columns: positions as 24-bit fixed-point numbers, opacities 0..255, colours, logarithms of the scales in sixteenths
from -10, rotations (version 2: x, y, z in a byte each; later: the three smallest parts in 10 bits each), coefficients
of the colours. Axes are right, up, back: a map is turned by 180 degrees about x, into the frame of PLY files (-y up).
"""

from pathlib import Path

import numpy as np
import torch

from ..foreign import read_bytes
from ..gaussians.rows import moved
from ..types import GaussianParams
from .packed_values import params_of, quaternion_of_three
from .splat_file import MAX_BYTES
from .spz_streams import WHAT, unpack, widths

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
