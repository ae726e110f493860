"""Which voxel blocks a frame can observe: in view, not beyond the largest depth, not hidden behind what is seen."""

import numpy as np
from numba import njit, prange

from gsfusion_nb.constants import BLOCK_VOXELS

from .depth_pyramid import farthest


@njit(parallel=True, cache=True, error_model="numpy")
def find_observable(coords, M, axis_z, limits, size, pyramid, seen):
    """Set ``seen`` for the blocks with a voxel that may be observed: in view, not beyond ``far_m``, not hidden.

    M [3, 4]: homogeneous pixel coordinates (U, V, Z) of a world point. axis_z: third row of T_CW.
    """
    B = coords.shape[0]
    height, width = size
    far, truncation = limits.far, limits.truncation
    largest, levels = pyramid.largest, pyramid.levels
    side = BLOCK_VOXELS * limits.voxel_size
    half_z = 0.5 * side * (abs(axis_z[0]) + abs(axis_z[1]) + abs(axis_z[2]))
    radius = 0.5 * side * np.sqrt(3.0)
    # |fx axis_x + (cx - edge) axis_z| for the two edges of the picture along u, and the same along v
    normal_u, normal_v = 0.0, 0.0
    for edge in (0.0, 1.0):
        u2, v2 = 0.0, 0.0
        for k in range(3):
            u2 += (M[0, k] - edge * (width + 2) * M[2, k]) ** 2
            v2 += (M[1, k] - edge * (height + 2) * M[2, k]) ** 2
        normal_u, normal_v = max(normal_u, radius * np.sqrt(u2)), max(normal_v, radius * np.sqrt(v2))
    chunk = 256
    for part in prange((B + chunk - 1) // chunk):
        for i in range(part * chunk, min(B, part * chunk + chunk)):
            x, y, z = side * (coords[i, 0] + 0.5), side * (coords[i, 1] + 0.5), side * (coords[i, 2] + 0.5)
            Z = M[2, 0] * x + M[2, 1] * y + M[2, 2] * z + M[2, 3]
            if Z + half_z <= 0.0 or Z - half_z >= far + truncation:
                continue
            U = M[0, 0] * x + M[0, 1] * y + M[0, 2] * z + M[0, 3]
            V = M[1, 0] * x + M[1, 1] * y + M[1, 2] * z + M[1, 3]
            # distances to the four sides of the view, times the lengths of their normals
            if min(U, (width + 2) * Z - U) < -normal_u or min(V, (height + 2) * Z - V) < -normal_v:
                continue
            low_u, low_v, high_u, high_v = 0.0, 0.0, width + 1.0, height + 1.0
            if Z - half_z > 0.01:
                low_u, high_u, low_v, high_v = _box_around(M, (U, V, Z), side)
                if high_u < 1.0 or high_v < 1.0 or low_u > width + 1 or low_v > height + 1:
                    continue
            box = (low_u - 1.0, high_u - 1.0, low_v - 1.0, high_v - 1.0)
            seen[i] = Z - half_z < farthest(largest, levels, box, width, height) + truncation + 1e-5 * Z


@njit(cache=True, error_model="numpy")
def _box_around(M, centre, side):
    """Smallest and largest u, and v, of the corners of a block in front of the camera."""
    U, V, Z = centre
    low_u, low_v, high_u, high_v = 1e9, 1e9, -1e9, -1e9
    for c in range(8):
        a = 0.5 * side if c & 1 else -0.5 * side
        b = 0.5 * side if c & 2 else -0.5 * side
        d = 0.5 * side if c & 4 else -0.5 * side
        inv_z = 1.0 / (Z + M[2, 0] * a + M[2, 1] * b + M[2, 2] * d)
        u = (U + M[0, 0] * a + M[0, 1] * b + M[0, 2] * d) * inv_z
        v = (V + M[1, 0] * a + M[1, 1] * b + M[1, 2] * d) * inv_z
        low_u, high_u = min(low_u, u), max(high_u, u)
        low_v, high_v = min(low_v, v), max(high_v, v)
    return low_u, high_u, low_v, high_v
