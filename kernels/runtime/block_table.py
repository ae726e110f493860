"""Where the voxel blocks of a map are in its pool: the dense table of ``tsdf.octree.BlockIndex``, for kernels."""

from typing import NamedTuple

import numpy as np


class BlockTable(NamedTuple):
    """A box of blocks, ``size`` [3] of them along each axis from block ``low`` [3]; z changes fastest in ``rows``."""

    rows: np.ndarray
    """Row in the pool of each block of the box, -1 where there is none."""
    low: np.ndarray
    size: np.ndarray
