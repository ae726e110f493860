"""What of the map a view can meet: depths between which each tile's rays do, and the voxels that they may look up."""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

import math

import numpy as np
from numba import njit, prange

from gsfusion_nb.constants import VOXELS_PER_BLOCK

from ..runtime.numba.simd import load, select, splat, store

f32 = np.float32
_ZERO, _ONE, _INFINITE = f32(0.0), f32(1.0), f32(np.inf)
_NEAR = f32(0.01)

TILE_PX = 16
"""Edge of the picture tiles whose rays start together, pixels."""

NEAR_END, FAR_END = range(2)
"""Columns of the depths between which a tile's rays can meet a block."""


@njit(cache=True, error_model="numpy")
def depth_spans(coords, T_CW, side, lens, size):
    """Depths between which the rays of each tile of pixels can meet a block. [rows, columns, 2]"""
    height, width = size
    ny, nx = (height + TILE_PX - 1) // TILE_PX, (width + TILE_PX - 1) // TILE_PX
    spans = np.empty((ny, nx, 2), np.float32)
    spans[:, :, NEAR_END] = np.inf
    spans[:, :, FAR_END] = _ZERO
    tile = f32(TILE_PX)
    for b in range(coords.shape[0]):
        low_z, high_z = f32(np.inf), f32(-np.inf)
        low_u, high_u, low_v, high_v = f32(np.inf), f32(-np.inf), f32(np.inf), f32(-np.inf)
        for c in range(8):
            X, Y, Z = (
                (coords[b, 0] + (c & 1)) * side,
                (coords[b, 1] + (c >> 1 & 1)) * side,
                (coords[b, 2] + (c >> 2)) * side,
            )
            x = f32(T_CW[0, 0] * X + T_CW[0, 1] * Y + T_CW[0, 2] * Z + T_CW[0, 3])
            y = f32(T_CW[1, 0] * X + T_CW[1, 1] * Y + T_CW[1, 2] * Z + T_CW[1, 3])
            z = f32(T_CW[2, 0] * X + T_CW[2, 1] * Y + T_CW[2, 2] * Z + T_CW[2, 3])
            low_z, high_z = min(low_z, z), max(high_z, z)
            safe = max(z, _NEAR)
            u, v = (lens.fx * x / safe + lens.cx) / tile, (lens.fy * y / safe + lens.cy) / tile
            low_u, high_u = min(low_u, u), max(high_u, u)
            low_v, high_v = min(low_v, v), max(high_v, v)
        if high_z <= _ZERO:
            continue
        u0, u1 = math.floor(max(low_u, -_ONE)), math.floor(min(high_u, f32(nx)))
        v0, v1 = math.floor(max(low_v, -_ONE)), math.floor(min(high_v, f32(ny)))
        if low_z <= _NEAR:  # it reaches behind the camera: taken to cover the whole picture
            u0, u1, v0, v1 = 0, nx - 1, 0, ny - 1
        for i in range(max(v0, 0), min(v1, ny - 1) + 1):
            for j in range(max(u0, 0), min(u1, nx - 1) + 1):
                spans[i, j, NEAR_END] = min(spans[i, j, NEAR_END], max(low_z, _ZERO))
                spans[i, j, FAR_END] = max(spans[i, j, FAR_END], high_z)
    return spans


@njit(parallel=True, cache=True, error_model="numpy")
def observed_field(coords, D, W, T_CW, lens, sizes, size, field):
    """Set ``field`` to D where a voxel has been observed, else infinity, in the blocks that rays may look up.

    Those are the blocks whose bounding sphere, larger by the reach of an interpolation, meets the view.
    """
    height, width = size
    voxel, side = sizes.voxel, sizes.block
    B = coords.shape[0]
    fx, fy, cx, cy = lens.fx, lens.fy, lens.cx, lens.cy
    radius = 0.5 * side * np.sqrt(3.0) + 2 * voxel
    slope_u, slope_v = np.sqrt(fx * fx + max(cx, width - cx) ** 2), np.sqrt(fy * fy + max(cy, height - cy) ** 2)
    chunk = 64
    for task in prange((B + chunk - 1) // chunk):
        infinite, zero = splat(_INFINITE), splat(_ZERO)
        for b in range(task * chunk, min(B, task * chunk + chunk)):
            X, Y, Z = (coords[b, 0] + 0.5) * side, (coords[b, 1] + 0.5) * side, (coords[b, 2] + 0.5) * side
            x = T_CW[0, 0] * X + T_CW[0, 1] * Y + T_CW[0, 2] * Z + T_CW[0, 3]
            y = T_CW[1, 0] * X + T_CW[1, 1] * Y + T_CW[1, 2] * Z + T_CW[1, 3]
            z = T_CW[2, 0] * X + T_CW[2, 1] * Y + T_CW[2, 2] * Z + T_CW[2, 3]
            left, right = fx * x + cx * z, (width - cx) * z - fx * x
            above, under = fy * y + cy * z, (height - cy) * z - fy * y
            if z < -radius or min(left, right) < -radius * slope_u or min(above, under) < -radius * slope_v:
                continue
            for at in range(b * VOXELS_PER_BLOCK, (b + 1) * VOXELS_PER_BLOCK, 16):
                store(field, at, select(load(W, at) > zero, load(D, at), infinite))
