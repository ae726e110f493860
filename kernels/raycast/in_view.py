"""What of the map a view can meet: depths between which each tile's rays do, and the voxels that they may look up."""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

import math

import numpy as np
from numba import njit, prange

from gsfusion_nb.tsdf.block_pool import VOXELS_PER_BLOCK

from ..runtime.numba.simd import load, select, splat, store

f32 = np.float32
_ZERO, _INFINITE = f32(0.0), f32(np.inf)
_NEAR = 0.01

_BEFORE = 1e-3
"""Rays start this far before the nearest block, in blocks: its wall is crossed in the way of all others."""

NEAR_END, FAR_END = range(2)
"""Columns of the depths between which a tile's rays can meet a block."""

_U0, _U1, _V0, _V1 = range(4)
"""Columns of the tiles that a block covers: first and last of a row, first and last row. None if last < first."""

_CHUNK = 64
"""Blocks of one parallel task."""

CHUNKS_AT_ONCE = 16
"""Such tasks that a thread takes together. Blocks in view were mostly made together, so halves of all are not even."""

FEW_RAYS = 12
"""Rays for each block in view below which its voxels are not copied. Where all is in the cache, marking a block takes
as long as about so many rays take to ask for W as well; fresh memory for the copy of a growing map takes longer."""


@njit(parallel=True, cache=True, error_model="numpy")
def look_up(blocks, T_CW, lens, sizes, size, tile_px, marked, spans):
    """Which blocks rays can meet, and where.

    Sets ``spans`` [rows, columns, 2] to the depths between which the rays of each tile of pixels can meet a block, and
    ``marked`` to D where a voxel has been observed, else infinity, in the blocks that rays may look up. Those are the
    blocks whose bounding sphere, larger by the reach of an interpolation, meets the view. Returns whether ``marked``
    has been set: it is left as it was where there are so few rays that the copy would take longer than they do.
    """
    coords, D, W = blocks
    B = coords.shape[0]
    ny, nx = spans.shape[0], spans.shape[1]
    covers, depths, met = np.empty((B, 4), np.int32), np.empty((B, 2), np.float32), np.empty(B, np.bool_)
    radius = 0.5 * sizes.block * np.sqrt(3.0) + 2 * sizes.voxel
    for task in prange((B + _CHUNK - 1) // _CHUNK):
        for b in range(task * _CHUNK, min(B, task * _CHUNK + _CHUNK)):
            covers[b, _U0], covers[b, _U1] = 0, -1
            met[b] = _meets_view(coords[b], T_CW, lens, sizes.block, size, radius)
            if met[b]:
                _project(coords[b], T_CW, lens, sizes.block, tile_px, (ny, nx), covers[b], depths[b])
    spans[:, :, NEAR_END], spans[:, :, FAR_END] = np.inf, _ZERO
    in_view = 0
    for b in range(B):
        in_view += met[b]
        if covers[b, _U1] < covers[b, _U0]:
            continue
        for i in range(covers[b, _V0], covers[b, _V1] + 1):
            for j in range(covers[b, _U0], covers[b, _U1] + 1):
                spans[i, j, NEAR_END] = min(spans[i, j, NEAR_END], depths[b, NEAR_END])
                spans[i, j, FAR_END] = max(spans[i, j, FAR_END], depths[b, FAR_END])
    many = size[0] * size[1] >= FEW_RAYS * in_view
    if many:
        for task in prange((B + _CHUNK - 1) // _CHUNK):
            for b in range(task * _CHUNK, min(B, task * _CHUNK + _CHUNK)):
                if met[b]:
                    _mark(D, W, b, marked)
    return many


@njit(cache=True, error_model="numpy")
def _mark(D, W, block, marked):
    """D of a block's voxels, infinite where they have not been observed."""
    infinite, zero = splat(_INFINITE), splat(_ZERO)
    for at in range(block * VOXELS_PER_BLOCK, (block + 1) * VOXELS_PER_BLOCK, 16):
        store(marked, at, select(load(W, at) > zero, load(D, at), infinite))


@njit(cache=True, error_model="numpy")
def _meets_view(block, T_CW, lens, side, size, radius):
    """Whether the sphere around a block's centre meets the view."""
    height, width = size
    fx, fy, cx, cy = lens.fx, lens.fy, lens.cx, lens.cy
    X, Y, Z = (block[0] + 0.5) * side, (block[1] + 0.5) * side, (block[2] + 0.5) * side
    z = T_CW[2, 0] * X + T_CW[2, 1] * Y + T_CW[2, 2] * Z + T_CW[2, 3]
    if z < -radius:
        return False
    x = T_CW[0, 0] * X + T_CW[0, 1] * Y + T_CW[0, 2] * Z + T_CW[0, 3]
    y = T_CW[1, 0] * X + T_CW[1, 1] * Y + T_CW[1, 2] * Z + T_CW[1, 3]
    slope_u, slope_v = math.sqrt(fx * fx + max(cx, width - cx) ** 2), math.sqrt(fy * fy + max(cy, height - cy) ** 2)
    aside = min(fx * x + cx * z, (width - cx) * z - fx * x)
    above = min(fy * y + cy * z, (height - cy) * z - fy * y)
    return aside >= -radius * slope_u and above >= -radius * slope_v


@njit(cache=True, error_model="numpy")
def _project(block, T_CW, lens, side, tile_px, tiles, cover, depth):
    """The tiles that a block covers, and its depths."""
    ny, nx = tiles
    low_z, high_z = np.inf, -np.inf
    low_u, high_u, low_v, high_v = np.inf, -np.inf, np.inf, -np.inf
    for c in range(8):
        X, Y, Z = (block[0] + (c & 1)) * side, (block[1] + (c >> 1 & 1)) * side, (block[2] + (c >> 2)) * side
        x = T_CW[0, 0] * X + T_CW[0, 1] * Y + T_CW[0, 2] * Z + T_CW[0, 3]
        y = T_CW[1, 0] * X + T_CW[1, 1] * Y + T_CW[1, 2] * Z + T_CW[1, 3]
        z = T_CW[2, 0] * X + T_CW[2, 1] * Y + T_CW[2, 2] * Z + T_CW[2, 3]
        low_z, high_z = min(low_z, z), max(high_z, z)
        inv_z = 1.0 / (max(z, _NEAR) * tile_px)
        u, v = lens.fx * x * inv_z + lens.cx / tile_px, lens.fy * y * inv_z + lens.cy / tile_px
        low_u, high_u = min(low_u, u), max(high_u, u)
        low_v, high_v = min(low_v, v), max(high_v, v)
    if high_z <= 0.0:
        return
    depth[NEAR_END], depth[FAR_END] = max(low_z - _BEFORE * side, 0.0), high_z
    if low_z <= _NEAR:  # it reaches behind the camera: taken to cover the whole picture
        cover[_U0], cover[_U1], cover[_V0], cover[_V1] = 0, nx - 1, 0, ny - 1
        return
    cover[_U0], cover[_U1] = math.floor(min(max(low_u, 0.0), nx)), math.floor(min(max(high_u, -1.0), nx - 1.0))
    cover[_V0], cover[_V1] = math.floor(min(max(low_v, 0.0), ny)), math.floor(min(max(high_v, -1.0), ny - 1.0))
