"""Which chunks of a large map a view may show, one chunk after the other; each ends at its first
test that fails."""

import math

import numpy as np
from numba import njit

from gsfusion_nb.large_maps.chunks import (
    BEHIND_M,
    GRID,
    PIXEL_REACH,
    Chunks,
    axes_of,
    view_planes,
)
from gsfusion_nb.render.constants import FRUSTUM_CLAMP
from gsfusion_nb.types import Camera

from ..runtime.numba.launch import launching

_ROWS, _COLUMNS = GRID
_NO_DEPTH = np.empty((0, 0), np.float32)


def chunks_shown(
    chunks: Chunks, camera: Camera, T_CW: np.ndarray, farthest_m: np.ndarray | None = None
) -> np.ndarray:
    """See ``gsfusion_nb.large_maps.chunks``."""
    low, high, reach_m = (np.ascontiguousarray(column, np.float32) for column in chunks)
    planes = view_planes(camera)
    normals = planes[:, :3] @ T_CW[:3]
    lens = np.array([axis[1:] for axis in axes_of(camera)], np.float64)
    grid = _NO_DEPTH if farthest_m is None else np.ascontiguousarray(farthest_m, np.float32)
    is_shown = np.empty(len(low), np.bool_)
    with launching():
        _test_all(
            low,
            high,
            reach_m,
            normals,
            planes[:, 3].copy(),
            np.ascontiguousarray(T_CW),
            lens,
            grid,
            is_shown,
        )
    return is_shown


@njit(cache=True, error_model="numpy")
def _test_all(low, high, reach_m, normals, factors, T_CW, lens, grid, is_shown):
    """Write to ``is_shown`` of every chunk. lens: focal length, principal point and size of both
    axes."""
    for i in range(low.shape[0]):
        is_shown[i] = _is_in_view(low[i], high[i], reach_m[i], normals, factors)
        if is_shown[i] and grid.shape[0] > 0:
            is_shown[i] = not _is_behind(low[i], high[i], reach_m[i], T_CW, lens, grid)


@njit(cache=True, error_model="numpy")
def _is_in_view(low, high, reach_m, normals, factors):
    """Whether the corner of the box farthest inside each plane is inside; NaN counts as inside."""
    for k in range(normals.shape[0]):
        nearest = normals[k, 3]
        for axis in range(3):
            middle = (low[axis] + high[axis]) / np.float32(2.0)
            half = (high[axis] - low[axis]) / np.float32(2.0)
            nearest += normals[k, axis] * middle - abs(normals[k, axis]) * half
        if nearest > factors[k] * reach_m:
            return False
    return True


@njit(cache=True, error_model="numpy")
def _is_behind(low, high, reach_m, T_CW, lens, grid):
    """Whether all of the box is behind the depth in all cells that it may touch."""
    xyz = np.empty((8, 3))
    nearest_m = np.inf
    for corner in range(8):
        x = high[0] if corner & 4 else low[0]
        y = high[1] if corner & 2 else low[1]
        z = high[2] if corner & 1 else low[2]
        for axis in range(3):
            row = T_CW[axis]
            xyz[corner, axis] = row[0] * x + row[1] * y + row[2] * z + row[3]
        if not xyz[corner, 2] >= nearest_m:  # NaN stays
            nearest_m = xyz[corner, 2]
    nearest_m -= reach_m
    if not nearest_m > 0.0:
        return False
    slope = reach_m / nearest_m
    first_column, last_column = _cells(xyz, 0, lens[0], slope, _COLUMNS)
    first_row, last_row = _cells(xyz, 1, lens[1], slope, _ROWS)
    deepest_m = 0.0
    for r in range(_ROWS):
        for c in range(_COLUMNS):
            in_columns = first_column <= c and c <= last_column
            if in_columns and first_row <= r and r <= last_row:
                deepest_m = max(deepest_m, grid[r, c])
    return nearest_m > deepest_m + BEHIND_M


@njit(cache=True, error_model="numpy")
def _cells(xyz, axis, lens, slope, cells):
    """The first and the last cell of the picture that the box may touch along an axis."""
    f, c, size = lens
    lowest = np.inf
    highest = -np.inf
    for corner in range(8):
        uv = f * xyz[corner, axis] / xyz[corner, 2] + c
        lowest = min(lowest, uv)
        highest = max(highest, uv)
    more_px = f * (1.0 + FRUSTUM_CLAMP * size / (2.0 * f)) * slope + PIXEL_REACH
    return (
        math.floor((lowest - more_px) * cells / size),
        math.floor((highest + more_px) * cells / size),
    )
