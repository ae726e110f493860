"""Small functions of numba kernels: tasks dealt out in turn to threads, twists, blocks in view."""

import math

import numpy as np
from numba import njit, parallel_chunksize, prange

from gsfusion_nb.tsdf.block_pool import BLOCKS_IN_BOX
from gsfusion_nb.tsdf.volume import TsdfVolume

from ..arguments import Lens

GROUPS = 16


@njit(inline="always")
def cyclic_size(n):
    """Numbers that the loop runs through for ``n`` tasks: ``n`` rounded up to whole rounds."""
    return (n + GROUPS - 1) // GROUPS * GROUPS


@njit(inline="always")
def cyclic_task(k, n):
    """The task of number ``k`` of the loop; numbers from ``n`` on stand for no task."""
    rounds = (n + GROUPS - 1) // GROUPS
    return k % rounds * GROUPS + k // rounds


SMALL = 1e-4
"""Below this square of the angle the series are used, as in ``gsfusion_nb.geometry.se3.exp``."""


@njit(cache=True, error_model="numpy")
def solve_into(H, b, x):
    """Write the solution of H x = b to ``x``: Cholesky, H symmetric and positive definite; H is overwritten."""
    n = b.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = H[i, j]
            for k in range(j):
                total -= H[i, k] * H[j, k]
            H[i, j] = np.sqrt(total) if i == j else total / H[j, j]
        total = b[i]
        for k in range(i):
            total -= H[i, k] * x[k]
        x[i] = total / H[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= H[k, i] * x[k]
        x[i] = total / H[i, i]


@njit(cache=True, error_model="numpy")
def turn_about_camera(T, xi):
    """Replace the pose T [3, 4] by that after a twist about its camera along the world's axes, translation first."""
    a, b, c = xi[3], xi[4], xi[5]
    t2 = a * a + b * b + c * c
    if t2 < SMALL:
        A, B, C = 1.0 - t2 / 6.0 + t2 * t2 / 120.0, 0.5 - t2 / 24.0 + t2 * t2 / 720.0, 1.0 / 6.0 - t2 / 120.0
        C += t2 * t2 / 5040.0
    else:
        t = np.sqrt(t2)
        A, B, C = np.sin(t) / t, (1.0 - np.cos(t)) / t2, (t - np.sin(t)) / (t2 * t)
    for k in range(3):  # R v = v + A w x v + B w x (w x v)
        x, y, z = T[0, k], T[1, k], T[2, k]
        p, q, r = b * z - c * y, c * x - a * z, a * y - b * x
        T[0, k] = x + A * p + B * (b * r - c * q)
        T[1, k] = y + A * q + B * (c * p - a * r)
        T[2, k] = z + A * r + B * (a * q - b * p)
    x, y, z = xi[0], xi[1], xi[2]
    p, q, r = b * z - c * y, c * x - a * z, a * y - b * x
    T[0, 3] += x + B * p + C * (b * r - c * q)
    T[1, 3] += y + B * q + C * (c * p - a * r)
    T[2, 3] += z + B * r + C * (a * q - b * p)


def rows_in_view(volume: TsdfVolume, T_CW: np.ndarray, lens: Lens, size: tuple[int, int], end_m: float, more_m: float):
    """Rows of the blocks in view up to a depth: whose bounding sphere, larger by ``more_m``, meets it. int32"""
    met, coords, side = np.zeros(volume.n_blocks, np.bool_), volume.block_coords.numpy(), volume.block_size_m
    radius = 0.5 * side * math.sqrt(3.0) + more_m
    with parallel_chunksize(16):  # blocks in view were mostly made together, so halves of all are not even
        _meet(coords, volume.block_boxes, T_CW, lens, size, float(end_m), side, radius, met)
    return np.flatnonzero(met).astype(np.int32)


@njit(parallel=True, cache=True, error_model="numpy")
def _meet(coords, boxes, T_CW, lens, size, end, side, radius, met):
    """Set ``met`` for the blocks whose sphere meets the view; those of a box are looked at only if its sphere does."""
    for box in prange(len(boxes)):
        low, high = boxes[box, 0], boxes[box, 1]
        x, y, z = 0.5 * (low[0] + high[0] + 1), 0.5 * (low[1] + high[1] + 1), 0.5 * (low[2] + high[2] + 1)
        dx, dy, dz = high[0] - low[0], high[1] - low[1], high[2] - low[2]
        around = radius + 0.5 * side * math.sqrt(dx * dx + dy * dy + dz * dz)
        if _meets_view(side * x, side * y, side * z, T_CW, lens, size, end, 1.001 * around):  # for rounding
            for b in range(box * BLOCKS_IN_BOX, min(len(met), (box + 1) * BLOCKS_IN_BOX)):
                x, y, z = coords[b, 0] + 0.5, coords[b, 1] + 0.5, coords[b, 2] + 0.5
                met[b] = _meets_view(side * x, side * y, side * z, T_CW, lens, size, end, radius)


@njit(cache=True, error_model="numpy")
def _meets_view(X, Y, Z, T_CW, lens, size, end, radius):
    """Whether a sphere meets the view up to a depth."""
    height, width = size
    fx, fy, cx, cy = lens.fx, lens.fy, lens.cx, lens.cy
    z = T_CW[2, 0] * X + T_CW[2, 1] * Y + T_CW[2, 2] * Z + T_CW[2, 3]
    if z < -radius or z > end + radius:
        return False
    x = T_CW[0, 0] * X + T_CW[0, 1] * Y + T_CW[0, 2] * Z + T_CW[0, 3]
    y = T_CW[1, 0] * X + T_CW[1, 1] * Y + T_CW[1, 2] * Z + T_CW[1, 3]
    slope_u, slope_v = math.sqrt(fx * fx + max(cx, width - cx) ** 2), math.sqrt(fy * fy + max(cy, height - cy) ** 2)
    aside = min(fx * x + cx * z, (width - cx) * z - fx * x)
    above = min(fy * y + cy * z, (height - cy) * z - fy * y)
    return aside >= -radius * slope_u and above >= -radius * slope_v
