"""What of the map a view can meet: depths between which each tile's rays do, and the voxels that
they may look up."""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

import math

import numpy as np
from numba import njit, prange

from gsfusion_nb.tsdf.block_pool import VOXELS_PER_BLOCK

from ..runtime.numba.simd import load, select, splat, store

f32 = np.float32
_ZERO = f32(0.0)
_INFINITE = f32(np.inf)


_NEAR = 0.01

_BEFORE = 1e-3
"""Rays start this far before the nearest block, in blocks: its wall is crossed in the way of all
others."""

NEAR_END, FAR_END = range(2)
"""Columns of the depths between which a tile's rays can meet a block."""

_U0, _U1, _V0, _V1 = range(4)
"""Columns of the tiles that a block covers: first and last of a row, first and last row. None if
last < first."""

BLOCKS_AT_ONCE = 64
"""Blocks that a thread takes together."""

NEAR_BLOCKS = 1 << 21
"""Largest box of blocks around those in view (8 MB) of which a table is made for the rays."""

FEW_RAYS = 12
"""Rays for each block in view below which its voxels are not copied. Where all is in the cache,
marking a block takes as long as about so many rays take to ask for W as well; fresh memory for the
copy of a growing map takes longer."""


@njit(parallel=True, cache=True, error_model="numpy")
def look_up(blocks, rows, T_CW, lens, side, size, tile_px, distances, spans):
    """Where rays can meet the blocks in some ``rows``. blocks: [B, 3], and D and W of their voxels,
    block after block.

    Sets ``spans`` [rows, columns, 2] to the depths between which the rays of each tile of pixels
    can meet a block, and ``distances`` to D where a voxel has been observed, else infinity, in
    these blocks. Returns whether ``distances`` has been set: it is left as it was where there are
    so few rays that the copy would take longer than they do.
    """
    coords, D, W = blocks
    many = size[0] * size[1] >= FEW_RAYS * len(rows)
    covers = np.empty((len(rows), 4), np.int32)
    depths = np.empty((len(rows), 2), np.float32)
    for k in prange(len(rows)):
        covers[k, _U0] = 0
        covers[k, _U1] = -1
        _project(coords[rows[k]], T_CW, lens, side, tile_px, spans.shape[:2], covers[k], depths[k])
        if many:
            _mark(D, W, rows[k], distances)
    spans[:, :, NEAR_END] = np.inf
    spans[:, :, FAR_END] = _ZERO
    for k in range(len(rows)):
        if covers[k, _U1] < covers[k, _U0]:
            continue
        for i in range(covers[k, _V0], covers[k, _V1] + 1):
            for j in range(covers[k, _U0], covers[k, _U1] + 1):
                spans[i, j, NEAR_END] = min(spans[i, j, NEAR_END], depths[k, NEAR_END])
                spans[i, j, FAR_END] = max(spans[i, j, FAR_END], depths[k, FAR_END])
    return many


@njit(cache=True, error_model="numpy")
def near_blocks(coords, rows, most):
    """A table of the blocks in ``rows``, without entries if their box has more than ``most``
    blocks."""
    low = np.full(3, 1 << 30, np.int32)
    high = np.full(3, -(1 << 30), np.int32)
    for b in rows:
        for axis in range(3):
            low[axis] = min(low[axis], coords[b, axis])
            high[axis] = max(high[axis], coords[b, axis])
    size = np.maximum(high - low + np.int32(1), np.int32(0))
    cells = np.int64(size[0]) * size[1] * size[2]
    table = np.full(cells if cells <= most else 0, np.int32(-1), np.int32)
    if cells <= most:
        for b in rows:
            x = coords[b, 0] - low[0]
            y = coords[b, 1] - low[1]
            z = coords[b, 2] - low[2]
            table[(x * size[1] + y) * size[2] + z] = b
    return table, low, size


@njit(cache=True, error_model="numpy")
def _mark(D, W, block, distances):
    """D of a block's voxels, infinite where they have not been observed."""
    infinite = splat(_INFINITE)
    zero = splat(_ZERO)
    for at in range(block * VOXELS_PER_BLOCK, (block + 1) * VOXELS_PER_BLOCK, 16):
        store(distances, at, select(load(W, at) > zero, load(D, at), infinite))


@njit(cache=True, error_model="numpy")
def _project(block, T_CW, lens, side, tile_px, tiles, cover, depth):
    """The tiles that a block covers, and its depths."""
    ny, nx = tiles
    low_z = np.inf
    high_z = -np.inf
    low_u = np.inf
    high_u = -np.inf
    low_v = np.inf
    high_v = -np.inf
    for c in range(8):
        X = (block[0] + (c & 1)) * side
        Y = (block[1] + (c >> 1 & 1)) * side
        Z = (block[2] + (c >> 2)) * side
        x = T_CW[0, 0] * X + T_CW[0, 1] * Y + T_CW[0, 2] * Z + T_CW[0, 3]
        y = T_CW[1, 0] * X + T_CW[1, 1] * Y + T_CW[1, 2] * Z + T_CW[1, 3]
        z = T_CW[2, 0] * X + T_CW[2, 1] * Y + T_CW[2, 2] * Z + T_CW[2, 3]
        low_z = min(low_z, z)
        high_z = max(high_z, z)
        inv_z = 1.0 / (max(z, _NEAR) * tile_px)
        u = lens.fx * x * inv_z + lens.cx / tile_px
        v = lens.fy * y * inv_z + lens.cy / tile_px
        low_u = min(low_u, u)
        high_u = max(high_u, u)
        low_v = min(low_v, v)
        high_v = max(high_v, v)
    if high_z <= 0.0:
        return
    depth[NEAR_END] = max(low_z - _BEFORE * side, 0.0)
    depth[FAR_END] = high_z
    if low_z <= _NEAR:  # it reaches behind the camera: taken to cover the whole picture
        cover[_U0] = 0
        cover[_U1] = nx - 1
        cover[_V0] = 0
        cover[_V1] = ny - 1
        return
    cover[_U0] = math.floor(min(max(low_u, 0.0), nx))
    cover[_U1] = math.floor(min(max(high_u, -1.0), nx - 1.0))
    cover[_V0] = math.floor(min(max(low_v, 0.0), ny))
    cover[_V1] = math.floor(min(max(high_v, -1.0), ny - 1.0))
