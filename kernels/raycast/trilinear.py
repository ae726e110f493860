"""Trilinear interpolation of the voxels around sixteen points at a time.

What the numba kernels of the raycast are given: rays and lengths.

Where rays look D up: in a copy that tells what has been observed, or in the map with its W.

The march is compiled for each: with one for both that branches at every look-up, rays take 10 to 20 % longer.
"""

from typing import NamedTuple

import numpy as np
from numba import int32, njit, types
from numba.core.extending import overload

from gsfusion_nb.tsdf.block_pool import VOXELS_PER_BLOCK

from ..runtime.numba.simd import absolute, any_lane, either, floor, maximum, select, splat
from ..runtime.numba.simd_int import below, but_not, gather, gather_int, select_int, splat_int, truncate


class Rays(NamedTuple):
    """x / z of every four columns and y / z of every four rows, for four by four pixels [N, 16]; the pose [4, 4]."""

    x: np.ndarray
    y: np.ndarray
    T_WC: np.ndarray


class Sizes(NamedTuple):
    """Edge of a voxel, truncation distance and edge of a block, metres."""

    voxel: float | np.float32
    truncation: float | np.float32
    block: float | np.float32


class Blocks(NamedTuple):
    """The blocks [B, 3] and the values of their voxels, block after block."""

    coords: np.ndarray
    D: np.ndarray
    W: np.ndarray


# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false


_ZERO, _INFINITE = np.float32(0.0), np.float32(np.inf)


class Marked(NamedTuple):
    """D of every voxel that rays may look up, infinite where it has not been observed."""

    D: np.ndarray


class Unmarked(NamedTuple):
    """D and W of every voxel."""

    D: np.ndarray
    W: np.ndarray


def values(field, at, wanted):
    """D of sixteen voxels, infinite where they are not wanted or have not been observed; in compiled code only."""
    raise NotImplementedError


@overload(values, inline="always")
def _(field, at, wanted):
    if not isinstance(field, types.NamedTuple | types.NamedUniTuple):
        return None
    if field.instance_class is Marked:
        return lambda field, at, wanted: gather(field.D, at, wanted, splat(_INFINITE))

    def asking(field, at, wanted):
        observed = gather(field.W, at, wanted, splat(_ZERO)) > splat(_ZERO)
        return select(observed, gather(field.D, at, wanted, splat(_INFINITE)), splat(_INFINITE))

    return asking


f32 = np.float32
_ZERO, _HALF, _INFINITE = f32(0.0), f32(0.5), f32(np.inf)


@njit(cache=True, error_model="numpy")
def _corner(rows, field, cell, number, moved, inside, row, wanted):
    """Value and position of one corner of sixteen cells; ``moved`` are those where it lies in another block."""
    if any_lane(moved):
        nowhere = splat_int(int32(-1))
        row = select_int(moved, gather_int(rows, cell, moved & inside, nowhere), row)
    at = row * splat_int(int32(VOXELS_PER_BLOCK)) + number
    return values(field, at, wanted & (row >= splat_int(int32(0)))), at


@njit(cache=True, error_model="numpy")
def cells(table, field, px, py, pz, wanted):
    """The eight voxels around sixteen points: their values (infinite where not observed) and positions.

    Points are in voxels, less a half. Also returns which cells are observed whole, and the cells' lowest corners.
    """
    rows, low, size = table.rows, table.low, table.size
    one, seven, three, zero = splat_int(int32(1)), splat_int(int32(7)), splat_int(int32(3)), splat_int(int32(0))
    bx, by, bz = floor(px), floor(py), floor(pz)
    x, y, z = truncate(bx), truncate(by), truncate(bz)
    nx, ny, nz = splat_int(int32(size[0])), splat_int(int32(size[1])), splat_int(int32(size[2]))
    X0, Y0, Z0 = (x >> three) - splat_int(low[0]), (y >> three) - splat_int(low[1]), (z >> three) - splat_int(low[2])
    ox, oy, oz = wanted & ((x & seven) == seven), wanted & ((y & seven) == seven), wanted & ((z & seven) == seven)
    X1, Y1, Z1 = X0 + select_int(ox, one, zero), Y0 + select_int(oy, one, zero), Z0 + select_int(oz, one, zero)
    inx, iny, inz = below(X0, nx), below(Y0, ny), below(Z0, nz)
    jnx, jny, jnz = below(X1, nx), below(Y1, ny), below(Z1, nz)
    X0, X1, Y0, Y1 = X0 * ny * nz, X1 * ny * nz, Y0 * nz, Y1 * nz
    eight, sixty_four = splat_int(int32(8)), splat_int(int32(64))
    x0, x1 = (x & seven) * sixty_four, ((x + one) & seven) * sixty_four
    y0, y1 = (y & seven) * eight, ((y + one) & seven) * eight
    z0, z1 = z & seven, (z + one) & seven
    row = gather_int(rows, X0 + Y0 + Z0, wanted & inx & iny & inz, splat_int(int32(-1)))
    wanted = wanted & (row >= zero)
    none = ox & but_not(oy, oy)
    oxy, oxz, oyz = either(ox, oy), either(ox, oz), either(oy, oz)
    v0, a0 = _corner(rows, field, X0, x0 + y0 + z0, none, none, row, wanted)
    v1, a1 = _corner(rows, field, X1 + Y0 + Z0, x1 + y0 + z0, ox, jnx & iny & inz, row, wanted)
    v2, a2 = _corner(rows, field, X0 + Y1 + Z0, x0 + y1 + z0, oy, inx & jny & inz, row, wanted)
    v3, a3 = _corner(rows, field, X1 + Y1 + Z0, x1 + y1 + z0, oxy, jnx & jny & inz, row, wanted)
    v4, a4 = _corner(rows, field, X0 + Y0 + Z1, x0 + y0 + z1, oz, inx & iny & jnz, row, wanted)
    v5, a5 = _corner(rows, field, X1 + Y0 + Z1, x1 + y0 + z1, oxz, jnx & iny & jnz, row, wanted)
    v6, a6 = _corner(rows, field, X0 + Y1 + Z1, x0 + y1 + z1, oyz, inx & jny & jnz, row, wanted)
    v7, a7 = _corner(rows, field, X1 + Y1 + Z1, x1 + y1 + z1, either(oxy, oz), jnx & jny & jnz, row, wanted)
    most = maximum(maximum(maximum(v0, v1), maximum(v2, v3)), maximum(maximum(v4, v5), maximum(v6, v7)))
    whole = wanted & (most < splat(_INFINITE))
    return (v0, v1, v2, v3, v4, v5, v6, v7), (a0, a1, a2, a3, a4, a5, a6, a7), whole, (bx, by, bz)


@njit(cache=True, error_model="numpy")
def leaves(corner, px, py, pz, wanted):
    """Whether any of sixteen points lies in another cell than the one with this lowest ``corner``."""
    zero = splat(_ZERO)
    away = absolute(floor(px) - corner[0]) + absolute(floor(py) - corner[1]) + absolute(floor(pz) - corner[2])
    return any_lane(wanted & (away > zero))


@njit(cache=True, error_model="numpy")
def blend(v, f):
    """Trilinear interpolation between corners x + 2 y + 4 z."""
    fx, fy, fz = f
    y0, y1 = v[0] + (v[1] - v[0]) * fx, v[2] + (v[3] - v[2]) * fx
    y2, y3 = v[4] + (v[5] - v[4]) * fx, v[6] + (v[7] - v[6]) * fx
    z0, z1 = y0 + (y1 - y0) * fy, y2 + (y3 - y2) * fy
    return z0 + (z1 - z0) * fz


@njit(cache=True, error_model="numpy")
def interpolate(table, field, point, inv_voxel, wanted):
    """Trilinear D at sixteen world points, and where all eight voxels around them have been observed."""
    half = splat(_HALF)
    px, py, pz = point[0] * inv_voxel - half, point[1] * inv_voxel - half, point[2] * inv_voxel - half
    v, _, whole, corner = cells(table, field, px, py, pz, wanted)
    return blend(v, (px - corner[0], py - corner[1], pz - corner[2])), whole
