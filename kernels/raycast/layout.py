"""What the numba kernels of the raycast are given: rays and lengths."""

from typing import NamedTuple

import numpy as np


class Rays(NamedTuple):
    """x / z of every four columns and y / z of every four rows, for four by four pixels [N, 16]; the pose [4, 4]."""

    x: np.ndarray
    y: np.ndarray
    T_WC: np.ndarray


class Sizes(NamedTuple):
    """Edge of a voxel, truncation distance and edge of a block, metres."""

    voxel: float | np.float32
    truncation: float | np.float32
    block: float | np.float32


class Blocks(NamedTuple):
    """The blocks [B, 3] and the values of their voxels, block after block."""

    coords: np.ndarray
    D: np.ndarray
    W: np.ndarray
