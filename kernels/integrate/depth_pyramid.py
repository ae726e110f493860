"""The largest depth in any part of an image: a pyramid of tiles, made while depth and colour are packed into words."""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

from typing import NamedTuple

import numpy as np
from numba import int32, njit, prange, uint32, uint64

from ..runtime.numba.simd import load, maximum, select, splat, store
from ..runtime.numba.simd_int import byte_triples, float_bits, splat_int, store_pairs

f32 = np.float32
MISSING = f32(-1e9)
"""Unknown depth."""
_ZERO, _INFINITE = f32(0.0), f32(np.inf)

_TILE = 8
"""Edge of the finest tiles, pixels."""

_SCAN = 4
"""A box is looked up on the level of the pyramid where it is less than this many tiles wide."""

_FIRST, _ROWS, _COLUMNS = range(3)
"""Columns of a pyramid's table of levels: place of the first number, rows, columns."""


class DepthPyramid(NamedTuple):
    """Largest depth of tiles of 8, 16, 32 ... pixels, level after level in one array."""

    largest: np.ndarray
    levels: np.ndarray
    """[L, 3]: see ``_FIRST``."""


def packed_image(depth: np.ndarray, colour: np.ndarray, near_m: float) -> tuple[np.ndarray, DepthPyramid]:
    """Depth bits and, if ``colour`` [H W 3] has any bytes, colour of every pixel in one word; a pyramid of depths.

    Unknown depth becomes ``MISSING``.
    """
    height, width = depth.shape
    levels = [(0, -(-height // _TILE), -(-width // _TILE))]
    while levels[-1][_ROWS] > 1 or levels[-1][_COLUMNS] > 1:
        first, h, w = levels[-1]
        levels.append((first + h * w, (h + 1) // 2, (w + 1) // 2))
    packed = np.empty(height * width, np.uint64)
    pyramid = DepthPyramid(largest=np.empty(levels[-1][_FIRST] + 1, np.float32), levels=np.array(levels))
    _pack(depth, colour, f32(near_m), pyramid, packed)
    return packed, pyramid


@njit(parallel=True, cache=True, error_model="numpy")
def _pack(depth, colour, near, pyramid, packed):
    """See ``packed_image``."""
    largest, levels = pyramid.largest, pyramid.levels
    height, width = depth.shape
    h, w = levels[0, _ROWS], levels[0, _COLUMNS]
    flat_depth, has_bytes = depth.reshape(-1), len(colour) > 0
    for i in prange(h):
        column = np.full(w * _TILE + 16, MISSING, np.float32)
        missing, zero, nearest, infinite = splat(MISSING), splat(_ZERO), splat(near), splat(_INFINITE)
        for y in range(i * _TILE, min(height, i * _TILE + _TILE)):
            for x in range(0, width - 15, 16):
                at = y * width + x
                d = load(flat_depth, at)
                d = select((d > zero) & (d >= nearest) & (d < infinite), d, missing)
                store(column, x, maximum(load(column, x), d))
                store_pairs(packed, at, d, byte_triples(colour, 3 * at) if has_bytes else splat_int(int32(0)))
            for x in range(width - width % 16, width):
                d = depth[y, x]
                d = d if (d > _ZERO) & (d >= near) & (d < _INFINITE) else MISSING
                column[x] = max(column[x], d)
                at, word = y * width + x, uint32(0)
                if has_bytes:
                    for c in range(3):
                        word |= uint32(colour[3 * at + c]) << uint32(8 * c)
                packed[at] = uint64(float_bits(d)) | uint64(word) << uint64(32)
        for j in range(w):
            most = MISSING
            for x in range(j * _TILE, j * _TILE + _TILE):
                most = max(most, column[x])
            largest[i * w + j] = most
    for k in range(1, levels.shape[0]):
        below, fine_h, fine_w = levels[k - 1, _FIRST], levels[k - 1, _ROWS], levels[k - 1, _COLUMNS]
        for i in range(levels[k, _ROWS]):
            for j in range(levels[k, _COLUMNS]):
                most = MISSING
                for y in range(2 * i, min(2 * i + 2, fine_h)):
                    for x in range(2 * j, min(2 * j + 2, fine_w)):
                        most = max(most, largest[below + y * fine_w + x])
                largest[levels[k, _FIRST] + i * levels[k, _COLUMNS] + j] = most


@njit(cache=True, error_model="numpy")
def farthest(largest, levels, box, width, height):
    """Largest known depth in a box of pixels."""
    low_u, high_u, low_v, high_v = box
    u0, u1 = int(max(low_u, 0.0)), int(min(high_u, width - 1.0))
    v0, v1 = int(max(low_v, 0.0)), int(min(high_v, height - 1.0))
    level, tile = 0, _TILE
    while level < levels.shape[0] - 1 and max(u1 // tile - u0 // tile, v1 // tile - v0 // tile) >= _SCAN:
        level, tile = level + 1, tile * 2
    first, columns = levels[level, _FIRST], levels[level, _COLUMNS]
    most = MISSING
    for i in range(v0 // tile, v1 // tile + 1):
        for j in range(u0 // tile, u1 // tile + 1):
            most = max(most, largest[first + i * columns + j])
    return most
