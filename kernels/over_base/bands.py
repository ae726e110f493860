"""Bands of image rows, the splats in each, and the planes that a band is blended in (numba).

A plane holds one number for each pixel, row by row. Its rows are a vector longer than the image's, so that sixteen
lanes may begin at any pixel.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

from typing import NamedTuple

import numpy as np
from numba import njit

from ..project.splat import EXTENT_U, EXTENT_V, U, V
from ..runtime.numba.simd import LANES

f32 = np.float32
_HALF = f32(0.5)

BAND = 8
"""Rows of a band."""


class BandLists(NamedTuple):
    """The splats that touch each band: band b has ``ids[offset[b] : offset[b + 1]]``, in the order of the map."""

    ids: np.ndarray
    offset: np.ndarray


class Surface(NamedTuple):
    """The base: colour [H, W, 3], depth and weight [H, W]. float32"""

    rgb: np.ndarray
    depth: np.ndarray
    weight: np.ndarray


class Blended(NamedTuple):
    """What is made of it: colour [H, W, 3], depth [H, W] and the sum of weights [H, W]. float32"""

    rgb: np.ndarray
    depth: np.ndarray
    weight: np.ndarray


@njit(inline="always", cache=True)
def stride_of(width):
    """Length of a row of a plane."""
    return (width + 2 * LANES - 1) // LANES * LANES


@njit(inline="always")
def row_range(s, y0, y1):
    """Rows from ``y0`` to before ``y1`` that splat ``s`` reaches: the first, and the one behind the last."""
    return max(y0, int(np.ceil(s[V] - s[EXTENT_V] - _HALF))), min(y1, int(np.floor(s[V] + s[EXTENT_V] - _HALF)) + 1)


@njit(inline="always")
def column_range(s, width):
    """The same for columns of the image."""
    return max(0, int(np.ceil(s[U] - s[EXTENT_U] - _HALF))), min(width, int(np.floor(s[U] + s[EXTENT_U] - _HALF)) + 1)


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
    ids, cursor = np.empty(offset[n_bands], np.int32), offset[:-1].copy()
    for i in range(splats.shape[0]):
        if start[i] < start[i + 1]:
            first, end = row_range(splats[i], 0, height)
            for band in range(first // BAND, (end + BAND - 1) // BAND):
                ids[cursor[band]] = i
                cursor[band] += 1
    return BandLists(ids, offset)
