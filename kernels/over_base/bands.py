"""Bands of image rows: which splats touch each, and which of its pixels a splat reaches."""

from typing import NamedTuple

import numpy as np
from numba import njit

from ..composite.numba import HALF
from ..project.layout import EXTENT_U, EXTENT_V, U, V
from ..runtime.numba.simd import LANES

BAND = 8
"""Rows of a band."""


class BandLists(NamedTuple):
    """The splats that touch each band: band b has ``ids[offset[b] : offset[b + 1]]``, in the order
    of the map."""

    ids: np.ndarray
    offset: np.ndarray


@njit(inline="always", cache=True)
def stride_of(width):
    """Length of a row of a plane."""
    return (width + 2 * LANES - 1) // LANES * LANES


@njit(inline="always")
def row_range(s, y0, y1):
    """Rows from ``y0`` to before ``y1`` that splat ``s`` reaches: the first, and the one behind the
    last."""
    return max(y0, int(np.ceil(s[V] - s[EXTENT_V] - HALF))), min(
        y1, int(np.floor(s[V] + s[EXTENT_V] - HALF)) + 1
    )


@njit(inline="always")
def column_range(s, width):
    """The same for columns of the image."""
    return max(0, int(np.ceil(s[U] - s[EXTENT_U] - HALF))), min(
        width, int(np.floor(s[U] + s[EXTENT_U] - HALF)) + 1
    )


@njit(cache=True, error_model="numpy")
def list_bands(splats, start, height):
    """The splats of each band; row i is drawn where ``start[i] < start[i + 1]``."""
    n_bands = (height + BAND - 1) // BAND
    offset = np.zeros(n_bands + 1, np.int32)
    for i in range(splats.shape[0]):
        if start[i] < start[i + 1]:
            first, end = row_range(splats[i], 0, height)
            for band in range(first // BAND, (end + BAND - 1) // BAND):
                offset[band + 1] += 1
    for band in range(n_bands):
        offset[band + 1] += offset[band]
    ids = np.empty(offset[n_bands], np.int32)
    cursor = offset[:-1].copy()
    for i in range(splats.shape[0]):
        if start[i] < start[i + 1]:
            first, end = row_range(splats[i], 0, height)
            for band in range(first // BAND, (end + BAND - 1) // BAND):
                ids[cursor[band]] = i
                cursor[band] += 1
    return BandLists(ids, offset)
