"""What a frame can observe: depth and colour of each pixel in one word, a pyramid of the largest
depths, and the blocks that are not hidden behind it."""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

from typing import NamedTuple

import numpy as np
from numba import int32, njit, prange, uint32, uint64

from gsfusion_nb.tsdf.block_pool import BLOCK_VOXELS

from ..runtime.numba.simd import (
    byte_triples,
    float_bits,
    load,
    maximum,
    select,
    splat,
    splat_int,
    store,
    store_pairs,
)

f32 = np.float32
_ZERO = f32(0.0)
_INFINITE = f32(np.inf)


MISSING = f32(-1e9)
"""Unknown depth."""

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


def packed_image(
    depth: np.ndarray, colour: np.ndarray, near_m: float
) -> tuple[np.ndarray, DepthPyramid]:
    """Depth bits and, if ``colour`` [H W 3] has any bytes, colour of every pixel in one word; a
    pyramid of depths.

    Unknown depth becomes ``MISSING``.
    """
    height, width = depth.shape
    levels = [(0, -(-height // _TILE), -(-width // _TILE))]
    while levels[-1][_ROWS] > 1 or levels[-1][_COLUMNS] > 1:
        first, h, w = levels[-1]
        levels.append((first + h * w, (h + 1) // 2, (w + 1) // 2))
    pixels = np.empty(height * width, np.uint64)
    pyramid = DepthPyramid(
        largest=np.empty(levels[-1][_FIRST] + 1, np.float32), levels=np.array(levels)
    )
    _pack(depth, colour, f32(near_m), pyramid, pixels)
    return pixels, pyramid


@njit(parallel=True, cache=True, error_model="numpy")
def _pack(depth, colour, near_m, pyramid, pixels):
    """See ``packed_image``."""
    largest = pyramid.largest
    levels = pyramid.levels
    height, width = depth.shape
    h = levels[0, _ROWS]
    w = levels[0, _COLUMNS]
    flat_depth = depth.reshape(-1)
    has_bytes = len(colour) > 0
    for i in prange(h):
        column = np.full(w * _TILE + 16, MISSING, np.float32)
        missing = splat(MISSING)
        zero = splat(_ZERO)
        nearest = splat(near_m)
        infinite = splat(_INFINITE)
        for y in range(i * _TILE, min(height, i * _TILE + _TILE)):
            for x in range(0, width - 15, 16):
                at = y * width + x
                d = load(flat_depth, at)
                d = select((d > zero) & (d >= nearest) & (d < infinite), d, missing)
                store(column, x, maximum(load(column, x), d))
                store_pairs(
                    pixels,
                    at,
                    d,
                    byte_triples(colour, 3 * at) if has_bytes else splat_int(int32(0)),
                )
            for x in range(width - width % 16, width):
                d = depth[y, x]
                d = d if (d > _ZERO) & (d >= near_m) & (d < _INFINITE) else MISSING
                column[x] = max(column[x], d)
                at = y * width + x
                word = uint32(0)
                if has_bytes:
                    for c in range(3):
                        word |= uint32(colour[3 * at + c]) << uint32(8 * c)
                pixels[at] = uint64(float_bits(d)) | uint64(word) << uint64(32)
        for j in range(w):
            most = MISSING
            for x in range(j * _TILE, j * _TILE + _TILE):
                most = max(most, column[x])
            largest[i * w + j] = most
    for k in range(1, levels.shape[0]):
        first = levels[k - 1, _FIRST]
        fine_h = levels[k - 1, _ROWS]
        fine_w = levels[k - 1, _COLUMNS]
        for i in range(levels[k, _ROWS]):
            for j in range(levels[k, _COLUMNS]):
                most = MISSING
                for y in range(2 * i, min(2 * i + 2, fine_h)):
                    for x in range(2 * j, min(2 * j + 2, fine_w)):
                        most = max(most, largest[first + y * fine_w + x])
                largest[levels[k, _FIRST] + i * levels[k, _COLUMNS] + j] = most


@njit(cache=True, error_model="numpy")
def farthest(largest, levels, box, width, height):
    """Largest known depth in a box of pixels."""
    low_u, high_u, low_v, high_v = box
    u0 = int(max(low_u, 0.0))
    u1 = int(min(high_u, width - 1.0))
    v0 = int(max(low_v, 0.0))
    v1 = int(min(high_v, height - 1.0))
    level = 0
    tile = _TILE
    while (
        level < levels.shape[0] - 1
        and max(u1 // tile - u0 // tile, v1 // tile - v0 // tile) >= _SCAN
    ):
        level = level + 1
        tile = tile * 2
    first = levels[level, _FIRST]
    columns = levels[level, _COLUMNS]
    most = MISSING
    for i in range(v0 // tile, v1 // tile + 1):
        for j in range(u0 // tile, u1 // tile + 1):
            most = max(most, largest[first + i * columns + j])
    return most


@njit(parallel=True, cache=True, error_model="numpy")
def find_observable(coords, rows, M, axis_z, limits, size, pyramid):
    """Those of the ``blocks_in_view`` with a voxel that may be observed: in the picture, not too
    far, not hidden.

    M [3, 4]: homogeneous pixel coordinates (U, V, Z) of a world point. axis_z: third row of T_CW.
    """
    in_view = np.zeros(len(rows), np.bool_)
    height, width = size
    far_m = limits.far
    truncation = limits.truncation
    largest = pyramid.largest
    levels = pyramid.levels
    side = BLOCK_VOXELS * limits.voxel_size
    half_z = 0.5 * side * (abs(axis_z[0]) + abs(axis_z[1]) + abs(axis_z[2]))
    for i in prange(len(rows)):
        b = rows[i]
        x = side * (coords[b, 0] + 0.5)
        y = side * (coords[b, 1] + 0.5)
        z = side * (coords[b, 2] + 0.5)
        Z = M[2, 0] * x + M[2, 1] * y + M[2, 2] * z + M[2, 3]
        if Z + half_z <= 0.0 or Z - half_z >= far_m + truncation:
            continue
        U = M[0, 0] * x + M[0, 1] * y + M[0, 2] * z + M[0, 3]
        V = M[1, 0] * x + M[1, 1] * y + M[1, 2] * z + M[1, 3]
        low_u = 0.0
        low_v = 0.0
        high_u = width + 1.0
        high_v = height + 1.0
        if Z - half_z > 0.01:
            low_u, high_u, low_v, high_v = _box_around(M, (U, V, Z), side)
            if high_u < 1.0 or high_v < 1.0 or low_u > width + 1 or low_v > height + 1:
                continue
        box = (low_u - 1.0, high_u - 1.0, low_v - 1.0, high_v - 1.0)
        in_view[i] = (
            Z - half_z < farthest(largest, levels, box, width, height) + truncation + 1e-5 * Z
        )
    return rows[in_view]


@njit(cache=True, error_model="numpy")
def _box_around(M, centre, side):
    """Smallest and largest u, and v, of the corners of a block in front of the camera."""
    U, V, Z = centre
    low_u = 1e9
    low_v = 1e9
    high_u = -1e9
    high_v = -1e9
    for c in range(8):
        a = 0.5 * side if c & 1 else -0.5 * side
        b = 0.5 * side if c & 2 else -0.5 * side
        d = 0.5 * side if c & 4 else -0.5 * side
        inv_z = 1.0 / (Z + M[2, 0] * a + M[2, 1] * b + M[2, 2] * d)
        u = (U + M[0, 0] * a + M[0, 1] * b + M[0, 2] * d) * inv_z
        v = (V + M[1, 0] * a + M[1, 1] * b + M[1, 2] * d) * inv_z
        low_u = min(low_u, u)
        high_u = max(high_u, u)
        low_v = min(low_v, v)
        high_v = max(high_v, v)
    return low_u, high_u, low_v, high_v
