"""How compact files of Gaussians store numbers: bits of whole numbers, rotations without their largest part."""

import numpy as np
import torch

from ..geometry.spherical_harmonics import SH_C0
from ..types import GaussianParams

MAX_BYTES = 2_000_000_000
"""Of a file that is read at once: 60 million Gaussians."""
LEAST_OPACITY = 1e-6
"""Opacities are kept this far from 0 and 1, where the logit is infinite."""


def share(packed: np.ndarray, shift: int, bits: int) -> np.ndarray:
    """The whole number in some bits of ``packed``, as a share 0..1 of the largest one, float64."""
    most = (1 << bits) - 1
    return ((packed >> np.uint32(shift)) & np.uint32(most)).astype(np.float64) / most


def quaternion_of_three(three: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Unit quaternions from three parts and the place of the fourth, which is the largest and positive.

    Args:
        three: The parts in their order, without the largest. [N, 3]
        largest: Its place in the quaternion, 0 to 3. [N]

    Returns:
        In the order of the file. [N, 4]
    """
    rows = np.arange(len(three))
    out = np.empty((len(three), 4))
    left_out = np.arange(4)[None] != largest[:, None]
    out[left_out] = three.reshape(-1)
    out[rows, largest] = np.sqrt(np.maximum(0.0, 1.0 - (three**2).sum(axis=1)))
    return out


def params_of(
    xyz: np.ndarray, log_scale: np.ndarray, quat: np.ndarray, opacity: np.ndarray, sh: np.ndarray
) -> GaussianParams:
    """A map from columns in float64: opacity 0..1, quaternions wxyz, coefficients [N, K, 3]."""
    clear = np.clip(opacity, LEAST_OPACITY, 1 - LEAST_OPACITY)
    columns = {
        "xyz_W": xyz,
        "log_scale": log_scale,
        "quat": quat,
        "opacity_logit": np.log(clear / (1 - clear)),
        "sh": sh,
    }
    return GaussianParams(
        **{name: torch.from_numpy(np.ascontiguousarray(column, dtype=np.float32)) for name, column in columns.items()}
    )


def sh_of_rgb(rgb: np.ndarray) -> np.ndarray:
    """The constant coefficient of a colour 0..1."""
    return (rgb - 0.5) / SH_C0
