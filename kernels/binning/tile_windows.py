"""Where the pixels to be drawn are, tile by tile: the numba kernels list a splat only in tiles where it can be seen."""

from typing import NamedTuple

import numpy as np

FIRST_X, LAST_X, FIRST_Y, LAST_Y = range(4)
"""Columns of ``TileWindows.windows``."""


class TileWindows(NamedTuple):
    """The bounding box of the pixels to be drawn in each tile, and how many tiles have any."""

    windows: np.ndarray
    """int32 [tiles, 4], first and last column, first and last row, in pixels of the image; in a tile without any, the
    first is behind the last. [0, 4] if all pixels are to be drawn."""
    sums: np.ndarray
    """int32 [tiles_y + 1, tiles_x + 1]: ``sums[j, i]`` tiles above row j and left of column i have any."""
