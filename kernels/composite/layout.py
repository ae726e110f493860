"""Arrays that the kernels of compositing share: tiles, lists of pairs, images, sums of the
gradient."""

from typing import NamedTuple

import numpy as np

TILE = 16
"""Edge of a tile, pixels, as in ``splat.cuh``; in numba a row of it is one vector."""


class PairLists(NamedTuple):
    """The (splat, tile) pairs, sorted by tile, then by depth: tile t has those from ``offset[t]``
    to ``offset[t + 1]``. int32"""

    ids: np.ndarray
    """Splat of each pair."""
    offset: np.ndarray
    slot: np.ndarray
    """Where the pair's sums go: the slots of a splat are consecutive."""


class Image(NamedTuple):
    """Colour [H, W, 3], depth and alpha [H, W], or dL/d of each; [0, 0] stands for zero. float32"""

    rgb: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray


class IndexImages(NamedTuple):
    """Rows of the first and of the heaviest splat of each pixel, and of the first opaque one; -1
    for none.

    int64 [H, W], or [0, 0] if not wanted.
    """

    first: np.ndarray
    dominant: np.ndarray
    hit: np.ndarray


SUM_GX, SUM_GY, SUM_GXX, SUM_GXY, SUM_GYY, SUM_G, SUM_RED, SUM_GREEN, SUM_BLUE, SUM_DEPTH = range(
    10
)

PAIR_SUMS = 10
"""Numbers in a row."""
