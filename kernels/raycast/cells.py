"""The cells of sixteen points: the eight voxels around each, and D between them."""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

from typing import NamedTuple

import numpy as np
from numba import int32, int64, njit, types
from numba.core.extending import overload

from gsfusion_nb.tsdf.block_pool import VOXELS_PER_BLOCK

from ..runtime.arguments import IN_NODE, NODE_BITS, NODE_SHIFT
from ..runtime.numba.scalars import kernel_part
from ..runtime.numba.simd import (
    absolute,
    any_lane,
    below,
    but_not,
    either,
    floor,
    gather,
    gather_int,
    maximum,
    select,
    select_int,
    splat,
    splat_int,
    splat_of_class,
    truncate,
)

f32 = np.float32
_ZERO = f32(0.0)
_HALF = f32(0.5)
_INFINITE = f32(np.inf)


class Sizes(NamedTuple):
    """Edge of a voxel, truncation distance and edge of a block, metres."""

    voxel: np.float32
    truncation: np.float32
    block: np.float32


class Marked(NamedTuple):
    """D of every voxel that rays may look up, infinite where it has not been observed."""

    D: np.ndarray


class Unmarked(NamedTuple):
    """D and W of every voxel."""

    D: np.ndarray
    W: np.ndarray


def values(field, at, mask):
    """D of sixteen voxels, infinite where they are not wanted or have not been observed; in
    compiled code only."""
    raise NotImplementedError


@overload(values, jit_options={"forceinline": True})
def _(field, at, mask):
    if not isinstance(field, types.NamedTuple | types.NamedUniTuple):
        return None
    if field.instance_class is Marked:
        return lambda field, at, mask: gather(field.D, at, mask, splat(_INFINITE))

    def asking(field, at, mask):
        observed = gather(field.W, at, mask, splat(_ZERO)) > splat(_ZERO)
        return select(observed, gather(field.D, at, mask, splat(_INFINITE)), splat(_INFINITE))

    return asking


class Near(NamedTuple):
    """Pool rows of the blocks that rays may look up, in a box around them: one look-up instead of
    two."""

    rows: np.ndarray
    """Of each block of the box, z fastest; -1 where there is none."""
    low: np.ndarray
    """Lowest block of the box. [3]"""
    size: np.ndarray
    """Blocks along each axis. [3]"""


_entry_shift = splat_of_class(lambda table: 3 if table is Near else NODE_SHIFT)
_in_entry = splat_of_class(lambda table: 0 if table is Near else IN_NODE)


@kernel_part
def place(table, axis, voxel):
    """Where sixteen voxels are along an axis: what that adds to the number of an entry of the
    table's box, and to those of the block in this entry and of the voxel in the block; and whether
    it is in the box.
    """
    stride = int64(1)
    if axis < 2:
        stride = int64(table.size[2])
    if axis == 0:
        stride *= table.size[1]
    entry = (voxel >> _entry_shift(table)) - splat_int(table.low[axis])
    in_entry = ((voxel >> splat_int(int32(3))) & _in_entry(table)) * splat_int(
        int32(1 << NODE_BITS * (2 - axis))
    )
    in_block = (voxel & splat_int(int32(7))) * splat_int(int32(1 << 3 * (2 - axis)))
    return (
        entry * splat_int(int32(stride)),
        in_entry,
        in_block,
        below(entry, splat_int(table.size[axis])),
    )


@kernel_part
def at_places(x, y, z):
    """Entry, block in the entry, voxel in the block, and whether it is in the box, of places along
    the three axes."""
    return x[0] + y[0] + z[0], x[1] + y[1] + z[1], x[2] + y[2] + z[2], x[3] & y[3] & z[3]


def rows_of(table, at, mask):
    """Pool row of the blocks at sixteen places, -1 where there is none; in compiled code only."""
    raise NotImplementedError


@overload(rows_of, jit_options={"forceinline": True})
def _(table, at, mask):
    if table.instance_class is Near:
        return lambda table, at, mask: gather_int(
            table.rows, at[0], mask & at[3], splat_int(int32(-1))
        )

    def in_nodes(table, at, mask):
        node = gather_int(table.nodes, at[0], mask & at[3], splat_int(int32(0)))
        number = node * splat_int(int32(1 << 3 * NODE_BITS)) + at[1]
        return gather_int(table.rows, number, mask & at[3], splat_int(int32(-1)))

    return in_nodes


@njit(cache=True, error_model="numpy")
def _corner(table, field, place, in_next_block, row, mask):
    """Value and position of one corner of sixteen cells; ``in_next_block`` are those where it lies
    in another block."""
    if any_lane(in_next_block):
        row = select_int(in_next_block, rows_of(table, place, in_next_block), row)
    at = row * splat_int(int32(VOXELS_PER_BLOCK)) + place[2]
    return values(field, at, mask & (row >= splat_int(int32(0)))), at


@njit(cache=True, error_model="numpy")
def cells(table, field, px, py, pz, mask):
    """The eight voxels around sixteen points: their values (infinite where not observed) and
    positions.

    Points are in voxels, less a half. Also returns which cells are observed whole, and the cells'
    lowest corners.
    """
    one = splat_int(int32(1))
    seven = splat_int(int32(7))
    bx = floor(px)
    by = floor(py)
    bz = floor(pz)
    x = truncate(bx)
    y = truncate(by)
    z = truncate(bz)
    x0 = place(table, 0, x)
    y0 = place(table, 1, y)
    z0 = place(table, 2, z)
    x1 = place(table, 0, x + one)
    y1 = place(table, 1, y + one)
    z1 = place(table, 2, z + one)
    first = at_places(x0, y0, z0)
    row = rows_of(table, first, mask)
    mask = mask & (row >= splat_int(int32(0)))
    ox = mask & ((x & seven) == seven)
    oy = mask & ((y & seven) == seven)
    oz = mask & ((z & seven) == seven)
    none = but_not(ox, ox)
    oxy = either(ox, oy)
    oxz = either(ox, oz)
    oyz = either(oy, oz)
    v0, a0 = _corner(table, field, first, none, row, mask)
    v1, a1 = _corner(table, field, at_places(x1, y0, z0), ox, row, mask)
    v2, a2 = _corner(table, field, at_places(x0, y1, z0), oy, row, mask)
    v3, a3 = _corner(table, field, at_places(x1, y1, z0), oxy, row, mask)
    v4, a4 = _corner(table, field, at_places(x0, y0, z1), oz, row, mask)
    v5, a5 = _corner(table, field, at_places(x1, y0, z1), oxz, row, mask)
    v6, a6 = _corner(table, field, at_places(x0, y1, z1), oyz, row, mask)
    v7, a7 = _corner(table, field, at_places(x1, y1, z1), either(oxy, oz), row, mask)
    most = maximum(
        maximum(maximum(v0, v1), maximum(v2, v3)), maximum(maximum(v4, v5), maximum(v6, v7))
    )
    whole = mask & (most < splat(_INFINITE))
    return (v0, v1, v2, v3, v4, v5, v6, v7), (a0, a1, a2, a3, a4, a5, a6, a7), whole, (bx, by, bz)


@njit(cache=True, error_model="numpy")
def leaves(corner, px, py, pz, mask):
    """Whether any of sixteen points lies in another cell than the one with this lowest
    ``corner``."""
    zero = splat(_ZERO)
    distance = (
        absolute(floor(px) - corner[0])
        + absolute(floor(py) - corner[1])
        + absolute(floor(pz) - corner[2])
    )
    return any_lane(mask & (distance > zero))


@njit(cache=True, error_model="numpy")
def blend(v, f):
    """Trilinear interpolation between corners x + 2 y + 4 z."""
    fx, fy, fz = f
    y0 = v[0] + (v[1] - v[0]) * fx
    y1 = v[2] + (v[3] - v[2]) * fx
    y2 = v[4] + (v[5] - v[4]) * fx
    y3 = v[6] + (v[7] - v[6]) * fx
    z0 = y0 + (y1 - y0) * fy
    z1 = y2 + (y3 - y2) * fy
    return z0 + (z1 - z0) * fz


# which products are fused must not hang on the compiler
@njit(cache=True, error_model="numpy", forceinline=True)
def interpolate(table, field, point, inv_voxel, mask):
    """Trilinear D at sixteen world points, and where all eight voxels around them have been
    observed."""
    half = splat(_HALF)
    px = point[0] * inv_voxel - half
    py = point[1] * inv_voxel - half
    pz = point[2] * inv_voxel - half
    v, _, whole, corner = cells(table, field, px, py, pz, mask)
    return blend(v, (px - corner[0], py - corner[1], pz - corner[2])), whole


BITS_OF_VOXEL = VOXELS_PER_BLOCK.bit_length() - 1
"""Of a voxel's place in the pool, those that number it within its block."""
