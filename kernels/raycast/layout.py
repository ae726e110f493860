"""What the numba kernels of the raycast are given: rays and lengths."""

from typing import NamedTuple

import numpy as np


class Rays(NamedTuple):
    """x / z of every column and y / z of every row of pixels, and the pose [4, 4], float32."""

    x: np.ndarray
    y: np.ndarray
    T_WC: np.ndarray


class Sizes(NamedTuple):
    """Edge of a voxel, truncation distance and edge of a block, metres."""

    voxel: float | np.float32
    truncation: float | np.float32
    block: float | np.float32
