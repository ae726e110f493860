"""How many (Gaussian, tile) pairs the kernels can number, and where the pixels to be drawn are,
tile by tile.

The numba kernels list a splat only in tiles where it can be seen.
"""

from typing import NamedTuple

import numpy as np

MOST_PAIRS = 1 << 31
"""Kernels number pairs with 32 bits."""


def check_pairs(total: int) -> None:
    """Raise ``ValueError`` if there are more (Gaussian, tile) pairs than kernels can number."""
    if total >= MOST_PAIRS:
        raise ValueError(
            f"render_forward: {total} (Gaussian, tile) pairs are more than 2^31; draw a smaller "
            "image, or a map of smaller Gaussians"
        )


FIRST_X, LAST_X, FIRST_Y, LAST_Y = range(4)
"""Columns of ``TileWindows.windows``."""


class TileWindows(NamedTuple):
    """The bounding box of the pixels to be drawn in each tile, and how many tiles have any."""

    windows: np.ndarray
    """int32 [tiles, 4], first and last column, first and last row, in pixels of the image; in a
    tile without any, the first is behind the last. [0, 4] if all pixels are to be drawn."""
    sums: np.ndarray
    """int32 [tiles_y + 1, tiles_x + 1]: ``sums[j, i]`` tiles above row j and left of column i have
    any."""
