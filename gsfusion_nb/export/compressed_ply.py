"""Reading compressed PLY files (PlayCanvas, SuperSplat): groups of 256 Gaussians with bounds, 16 bytes per Gaussian.

Element ``chunk`` has the smallest and largest position, logarithm of the scale and colour of each group. Element
``vertex`` has four words of 32 bits: position and scale as shares of the bounds in 11, 10 and 11 bits; the rotation
without its largest part, 10 bits each, and that part's place in 2; colour and opacity in 8 bits each. Element ``sh``
has a byte for each coefficient, from -4 to 4.
"""

from pathlib import Path

import numpy as np

from ..errors import SequenceError
from ..types import GaussianParams
from .packed_values import params_of, quaternion_of_three, sh_of_rgb, share
from .ply_header import check_ply_rows

GROUP = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def is_compressed(ply) -> bool:
    """Whether a parsed PLY file is one of these."""
    return "chunk" in ply and "vertex" in ply and "packed_position" in (ply["vertex"].data.dtype.names or ())


def decompressed(path: Path, ply) -> GaussianParams:
    """The Gaussians of a parsed file.

    Raises:
        SequenceError: a property is missing, or there are fewer groups than Gaussians need.
    """
    rows, groups = ply["vertex"].data, ply["chunk"].data
    n = len(rows)
    bounds = [f"{side}_{a}" for a in ("x", "y", "z", "scale_x", "scale_y", "scale_z") for side in ("min", "max")]
    lacking = [name for name in _PACKED if name not in rows.dtype.names]
    lacking += [name for name in bounds if name not in groups.dtype.names]
    if lacking or len(groups) * GROUP < n:
        raise SequenceError(
            f"{path} has {len(groups)} groups for {n} Gaussians and lacks {', '.join(lacking) or 'no property'}; "
            f"expected a compressed PLY file with a group for every {GROUP}"
        )
    group = np.arange(n) // GROUP
    position, rotation, scale, colour = (rows[name].astype(np.uint32) for name in _PACKED)

    def between(shares: np.ndarray, axes: tuple[str, ...]) -> np.ndarray:
        low, high = (np.stack([groups[f"{side}_{a}"] for a in axes], 1).astype(np.float64) for side in ("min", "max"))
        check_ply_rows(path, "chunk", np.concatenate([low, high], 1), tuple(f"min_{a}" for a in axes + axes))
        return low[group] * (1 - shares) + high[group] * shares

    def in_32_bits(packed: np.ndarray) -> np.ndarray:
        return np.stack([share(packed, 21, 11), share(packed, 11, 10), share(packed, 0, 11)], axis=1)

    rgb = np.stack([share(colour, shift, 8) for shift in (24, 16, 8)], axis=1)
    rgb = between(rgb, ("r", "g", "b")) if "min_r" in groups.dtype.names else rgb
    three = np.stack([share(rotation, shift, 10) for shift in (20, 10, 0)], axis=1)
    quat = quaternion_of_three((three - 0.5) * np.sqrt(2.0), (rotation >> np.uint32(30)).astype(np.int64))
    sh = np.concatenate([sh_of_rgb(rgb)[:, None], _rest(path, ply, n)], axis=1)
    return params_of(
        between(in_32_bits(position), ("x", "y", "z")),
        between(in_32_bits(scale), ("scale_x", "scale_y", "scale_z")),
        quat, share(colour, 0, 8), sh,
    )  # fmt: skip


def _rest(path: Path, ply, n: int) -> np.ndarray:
    """The coefficients of higher degree. [N, K - 1, 3]"""
    if "sh" not in ply:
        return np.zeros((n, 0, 3))
    data = ply["sh"].data
    names = [f"f_rest_{i}" for i in range(len(data.dtype.names))]
    if len(names) not in (9, 24, 45) or set(names) != set(data.dtype.names) or len(data) != n:
        raise SequenceError(f"{path} has {len(data)} rows of {len(names)} coefficients for {n} Gaussians; damaged")
    steps = np.stack([data[name] for name in names], axis=1).astype(np.float64)
    shares = np.where(steps == 0, 0.0, np.where(steps == 255, 1.0, (steps + 0.5) / 256))
    return ((shares - 0.5) * 8).reshape(n, 3, -1).transpose(0, 2, 1)
