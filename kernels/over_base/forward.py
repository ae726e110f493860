"""Sums of weights and colours over a band of rows, one band a task, sixteen pixels a vector (numba).

Bands of image rows, the splats in each, and the planes that a band is blended in (numba).

A plane holds one number for each pixel, row by row. Its rows are a vector longer than the image's, so that sixteen
lanes may begin at any pixel.
"""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from ..composite.front_to_back import HALF, ONE, ZERO, across, alpha_of, row_exponent, zeros
from ..project.layout import BLUE, DEPTH, EXTENT_U, EXTENT_V, GREEN, RED, U, V
from ..runtime.numba.scalars import cyclic_size, cyclic_task
from ..runtime.numba.simd import LANES, any_lane, load, splat, store

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false


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


f32 = np.float32
_INFINITE = f32(np.inf)

_RED, _GREEN, _BLUE, _WEIGHT, _LIMIT, _DEPTH = range(6)
"""Planes of a band: sums of w c and of w, the depth behind which a splat is hidden, and the sum of w z."""


@njit(parallel=True, cache=True, error_model="numpy")
def blend_bands(splats, lists, base, behind, image):
    """Fill ``image`` from the splats and the base. behind: of the surface, where splats are hidden, metres."""
    n_bands = lists.offset.shape[0] - 1
    for k_band in prange(cyclic_size(n_bands)):
        band = cyclic_task(k_band, n_bands)
        if band < n_bands:
            _blend_band(band, splats, lists, base, behind, image)


@njit(cache=True, error_model="numpy")
def _blend_band(band, splats, lists, base, behind, image):
    """Fill the rows of one band."""
    height, width = image.weight.shape
    stride = stride_of(width)
    plane, y0, y1 = BAND * stride, band * BAND, min(height, band * BAND + BAND)
    state = zeros(6 * plane)
    for y in range(y0, y1):
        at = _LIMIT * plane + (y - y0) * stride
        for x in range(width):
            D = base.depth[y, x]
            state[at + x] = D + behind if D > ZERO else _INFINITE
    for k in range(lists.offset[band], lists.offset[band + 1]):
        _add(state, splats[lists.ids[k]], (y0, y1, width), (plane, stride))
    for y in range(y0, y1):
        _write_row(state, (y - y0) * stride, plane, y, base, image)


@njit(inline="always")
def _add(state, s, place, layout):
    """Add the weights of a splat, times its colour and depth, to the planes of the band at ``place``."""
    y0, y1, width = place
    plane, stride = layout
    first, end = row_range(s, y0, y1)
    left, right = column_range(s, width)
    red, green, blue, z = splat(s[RED]), splat(s[GREEN]), splat(s[BLUE]), splat(s[DEPTH])
    for x in range(left, right, LANES):
        _, q0, q1 = across(s, x)
        for y in range(first, end):
            log_alpha, seen = row_exponent(s, q0, q1, f32(y) + HALF - s[V])
            o = (y - y0) * stride + x
            seen = seen & (load(state, _LIMIT * plane + o) >= z)
            if not any_lane(seen):
                continue
            w = alpha_of(log_alpha, seen)
            store(state, o, load(state, o) + w * red)
            store(state, _GREEN * plane + o, load(state, _GREEN * plane + o) + w * green)
            store(state, _BLUE * plane + o, load(state, _BLUE * plane + o) + w * blue)
            store(state, _WEIGHT * plane + o, load(state, _WEIGHT * plane + o) + w)
            store(state, _DEPTH * plane + o, load(state, _DEPTH * plane + o) + w * z)


@njit(cache=True, error_model="numpy")
def _write_row(state, o, plane, y, base, image):
    """One row of the picture from the sums that begin at ``o``."""
    for x in range(image.weight.shape[1]):
        W, b, D = state[_WEIGHT * plane + o + x], base.weight[y, x], base.depth[y, x]
        image.weight[y, x] = W
        total = ONE / (b + W) if b + W > ZERO else ZERO
        image.rgb[y, x, 0] = (b * base.rgb[y, x, 0] + state[o + x]) * total
        image.rgb[y, x, 1] = (b * base.rgb[y, x, 1] + state[_GREEN * plane + o + x]) * total
        image.rgb[y, x, 2] = (b * base.rgb[y, x, 2] + state[_BLUE * plane + o + x]) * total
        there = ONE if D > ZERO else ZERO
        total = ONE / (there + W) if there + W > ZERO else ZERO
        image.depth[y, x] = ((D if D > ZERO else ZERO) + state[_DEPTH * plane + o + x]) * total
