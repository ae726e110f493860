"""March rays to the surface, four by four at a time: steps and tests are the reference's.

Before, find out what of the map the view can meet: depths between which each tile's rays do, and
the voxels that they may look up. Rays look D up in a copy that tells what has been observed, or in
the map with its W. The march is compiled for each: with one for both that branches at every
look-up, rays take 10 to 20 % longer.

Tried: packets of 32 rays (9 to 17 % less time, but the vector layer has 16 lanes); rays that start
at the nearest voxel with D < 0 (hardly less time, and some pixels lose their surface); no copy of
the blocks in view from 320x240 on (10 to 15 % longer); blocks looked up in the table of nodes, as
in larger views (20 % longer); rays that start at 8 m where no nearer block is (with 41,000 blocks
in view 1.6 ms less before the march, 3.5 ms more in it); blocks in view found by nodes of the table
instead of neighbours in the pool (scattered reads, twice the time before the march).
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

import math
from typing import NamedTuple

import numpy as np
import torch
from numba import int32, int64, njit, parallel_chunksize, prange, types
from numba.core.extending import overload
from torch import Tensor

from gsfusion_nb.geometry import se3
from gsfusion_nb.tsdf.block_pool import VOXELS_PER_BLOCK
from gsfusion_nb.tsdf.raycast import CLOSE_VOXELS, REFINEMENTS, STEP, RaycastOutput
from gsfusion_nb.tsdf.raycast import raycast as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Camera

from ..runtime.arguments import (
    IN_NODE,
    NODE_BITS,
    NODE_SHIFT,
    BlockTable,
    lens_of,
    parts,
    ray_slopes,
)
from ..runtime.numba.blocks import blocks_in_view
from ..runtime.numba.launch import launching, scratch
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
    load,
    maximum,
    minimum,
    select,
    select_int,
    splat,
    splat_int,
    splat_of_class,
    sqrt,
    store,
    truncate,
)

f32 = np.float32
_ZERO = f32(0.0)
_HALF = f32(0.5)
_ONE = f32(1.0)
_STEP = f32(STEP)
_CLOSE = f32(CLOSE_VOXELS)
_SMALL = f32(1e-9)
_INFINITE = f32(np.inf)
_MARGIN = f32(0.01)


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


TILE_PX = 8
"""Edge of the picture tiles whose rays start together, pixels: a multiple of 4."""

_DEPTH = 0
_NORMAL = 1
_RGB = 4
"""Rows of what sixteen rays bring back; normal and colour take three rows each."""
_LANE_ROWS = 7

_BITS_OF_VOXEL = VOXELS_PER_BLOCK.bit_length() - 1
"""Of a voxel's place in the pool, those that number it within its block."""


def raycast(volume: TsdfVolume, camera: Camera, T_WC: Tensor) -> RaycastOutput:
    """See ``gsfusion_nb.tsdf.raycast``."""
    table = volume.index.table
    if volume.D.dtype != torch.float32 or volume.device.type != "cpu" or table is None:
        return reference.reference(volume, camera, T_WC)
    depth, normal, rgb = (torch.empty(camera.height, camera.width, *n) for n in ((), (3,), (3,)))
    x, y = ray_slopes(camera)
    pose = T_WC.detach().cpu()
    rays = (
        _in_fours(x).tile(1, 4).numpy(),
        _in_fours(y).repeat_interleave(4, 1).numpy(),
        pose.to(torch.float32).numpy(),
    )
    lens = lens_of(camera, f32)
    size = (camera.height, camera.width)
    sizes = Sizes(
        *map(f32, (volume.config.voxel_size_m, volume.config.truncation_m, volume.block_size_m))
    )
    D, W, colours = (t.view(-1).numpy() for t in (volume.D, volume.W, volume.rgb_planes))
    blocks = volume.block_coords.numpy(), D, W
    T_CW = se3.inverse(pose.double()).numpy()
    spans = np.empty((parts(camera.height, TILE_PX), parts(camera.width, TILE_PX), 2), np.float32)
    with launching():
        copy = scratch("raycast", D.size)
        rows = blocks_in_view(volume, camera, T_CW, np.inf, 2 * volume.config.voxel_size_m)
        with parallel_chunksize(BLOCKS_AT_ONCE):
            has_copy = look_up(
                blocks, rows, T_CW, lens, volume.block_size_m, size, TILE_PX, copy, spans
            )
        field = Marked(copy) if has_copy else Unmarked(D, W)
        near_table = Near(*near_blocks(blocks[0], rows, NEAR_BLOCKS))
        with parallel_chunksize(spans.shape[1]):  # a row of tiles: neighbours meet the same voxels
            pictures = depth.numpy(), normal.numpy(), rgb.numpy()
            lookup = near_table if near_table.rows.size or not rows.size else BlockTable.of(table)
            _march(lookup, field, colours, rays, sizes, spans, TILE_PX, *pictures)
    return RaycastOutput(depth_m=depth, normal_W=normal, rgb=rgb)


def _in_fours(slopes: Tensor) -> Tensor:
    """Four slopes a row; the last one again where the picture ends within a row."""
    missing = -len(slopes) % 4
    return torch.cat([slopes, slopes[-1:].expand(missing)]).view(-1, 4)


@njit(inline="always")
def _to_wall(p, is_forward, per_block, inv_side):
    """Depth to add to leave, along one axis, the blocks that hold sixteen points."""
    position = p * inv_side
    fraction = position - floor(position)
    return select(is_forward, splat(_ONE) - fraction, fraction) * per_block


@njit(cache=True, error_model="numpy")
def _crossing(table, field, origin, direction, sizes, span, alive):
    """Depths on either side of the first change from free to inside along sixteen rays, D there,
    and where it is."""
    ox, oy, oz = origin
    dx, dy, dz = direction
    zero = splat(_ZERO)
    one = splat(_ONE)
    infinite = splat(_INFINITE)
    small = splat(_SMALL)
    voxel = splat(sizes.voxel)
    truncation = splat(sizes.truncation)
    side = splat(sizes.block)
    inv_voxel = one / voxel
    inv_side = one / side
    reach = splat(_STEP) * truncation
    close_by = splat(_CLOSE) * voxel
    margin = splat(_MARGIN) * voxel
    block = splat_int(int32(VOXELS_PER_BLOCK))
    per_m = one / sqrt(dx * dx + dy * dy + dz * dz)
    per_x = side / maximum(absolute(dx), small)
    per_y = side / maximum(absolute(dy), small)
    per_z = side / maximum(absolute(dz), small)
    to_x = dx > zero
    to_y = dy > zero
    to_z = dz > zero
    z_start, z_end = span
    z = splat(z_start)
    z_end = splat(z_end)
    has_crossing = but_not(alive, alive)
    was_free = has_crossing
    was_inside = has_crossing
    z_before = z
    D_before = one
    z0 = z
    z1 = z
    D0 = one
    D1 = zero - one
    while any_lane(alive):
        px = ox + dx * z
        py = oy + dy * z
        pz = oz + dz * z
        i = truncate(floor(px * inv_voxel))
        j = truncate(floor(py * inv_voxel))
        k = truncate(floor(pz * inv_voxel))
        here_at = at_places(place(table, 0, i), place(table, 1, j), place(table, 2, k))
        row = rows_of(table, here_at, alive)
        has_block = row >= splat_int(int32(0))
        distance = infinite
        step = voxel * per_m
        if any_lane(has_block):
            at = row * block + here_at[2]
            distance = values(field, at, has_block)
            has_value = distance < infinite
            close = has_value & (absolute(distance) * truncation < close_by)
            if any_lane(close):
                smooth, whole = interpolate(table, field, (px, py, pz), inv_voxel, close)
                distance = select(whole, smooth, distance)
            step = select(has_value, maximum(reach * absolute(distance), voxel), voxel) * per_m
        no_block = but_not(alive, has_block)
        if any_lane(no_block):
            next_z = minimum(
                minimum(_to_wall(px, to_x, per_x, inv_side), _to_wall(py, to_y, per_y, inv_side)),
                _to_wall(pz, to_z, per_z, inv_side),
            )
            step = select(no_block, next_z + margin, step)
        has_value = distance < infinite
        free = has_value & (distance >= zero)
        is_negative = has_value & (zero > distance)
        crossing = is_negative & was_free
        has_crossing = either(has_crossing, crossing)
        z0 = select(crossing, z_before, z0)
        z1 = select(crossing, z, z1)
        D0 = select(crossing, D_before, D0)
        D1 = select(crossing, distance, D1)
        next_z = z + step
        alive = but_not(but_not(alive, crossing), free & was_inside) & (next_z < z_end)
        z_before = z
        D_before = distance
        was_free = free & alive
        was_inside = is_negative & alive
        z = select(alive, next_z, z)
    return (z0, z1, D0, D1), has_crossing


@njit(inline="always")
def _in_voxels(origin, direction, z, inv_voxel):
    """Points of sixteen rays, in voxels, less a half."""
    half = splat(_HALF)
    return (
        (origin[0] + direction[0] * z) * inv_voxel - half,
        (origin[1] + direction[1] * z) * inv_voxel - half,
        (origin[2] + direction[2] * z) * inv_voxel - half,
    )


@njit(cache=True, error_model="numpy")
def _refined(table, field, origin, direction, voxel, bracket, has_crossing):
    """Depth where D is zero on sixteen rays, between two depths on either side of the surface: the
    secant method.

    And the voxels around the points there, as of ``cells``, with their places between them. The
    points move so little that the voxels are seldom looked up again.
    """
    z0, z1, D0, D1 = bracket
    zero = splat(_ZERO)
    inv_voxel = splat(_ONE) / voxel
    z = z0 + (z1 - z0) * (D0 / (D0 - D1))
    px, py, pz = _in_voxels(origin, direction, z, inv_voxel)
    v, at, whole, corner = cells(table, field, px, py, pz, has_crossing)
    for _ in range(REFINEMENTS):
        distance = blend(v, (px - corner[0], py - corner[1], pz - corner[2]))
        is_positive = whole & (distance >= zero)
        is_negative = whole & (zero > distance)
        z0 = select(is_positive, z, z0)
        D0 = select(is_positive, distance, D0)
        z1 = select(is_negative, z, z1)
        D1 = select(is_negative, distance, D1)
        z = z0 + (z1 - z0) * (D0 / (D0 - D1))
        px, py, pz = _in_voxels(origin, direction, z, inv_voxel)
        if leaves(corner, px, py, pz, has_crossing):
            v, at, whole, corner = cells(table, field, px, py, pz, has_crossing)
    return z, v, at, (px - corner[0], py - corner[1], pz - corner[2]), whole


@njit(parallel=True, cache=True, error_model="numpy")
def _march(table, field, C, rays, sizes, spans, tile_px, depth, normal, rgb):
    """Fill the three pictures, four by four rays at a time; zero where no ray meets a surface
    observed on all sides.

    rays: x / z of every four columns and y / z of every four rows, for four by four pixels [N, 16];
    the pose [4, 4].
    """
    x, y, T = rays
    height, width = depth.shape
    ny = spans.shape[0]
    nx = spans.shape[1]
    packets = tile_px // 4
    for tile in prange(ny * nx):
        ti = int64(tile) // nx
        tj = int64(tile) % nx
        lanes = np.empty((_LANE_ROWS, 16), np.float32)
        origin = (splat(T[0, 3]), splat(T[1, 3]), splat(T[2, 3]))
        span = (spans[ti, tj, NEAR_END], spans[ti, tj, FAR_END])
        alive = splat(span[1]) > splat(span[0])
        for part in range(packets * packets):
            i = ti * packets + part // packets
            j = tj * packets + part % packets
            v0 = 4 * i
            u0 = 4 * j
            if v0 >= height or u0 >= width:
                continue
            sx = load(x[j], 0)
            sy = load(y[i], 0)
            dx = splat(T[0, 0]) * sx + splat(T[0, 1]) * sy + splat(T[0, 2])
            dy = splat(T[1, 0]) * sx + splat(T[1, 1]) * sy + splat(T[1, 2])
            dz = splat(T[2, 0]) * sx + splat(T[2, 1]) * sy + splat(T[2, 2])
            bracket, has_crossing = _crossing(
                table, field, origin, (dx, dy, dz), sizes, span, alive
            )
            if any_lane(has_crossing):
                z, values, at, f, whole = _refined(
                    table, field, origin, (dx, dy, dz), splat(sizes.voxel), bracket, has_crossing
                )
                _surface_into(values, at, f, whole, z, C, lanes)
            else:
                lanes[:] = _ZERO
            for k in range(16):
                v = v0 + k // 4
                u = u0 + k % 4
                if v < height and u < width:
                    depth[v, u] = lanes[_DEPTH, k]
                    for c in range(3):
                        normal[v, u, c] = lanes[_NORMAL + c, k]
                        rgb[v, u, c] = lanes[_RGB + c, k]


@njit(cache=True, error_model="numpy")
def _surface_into(v, at, f, whole, z, C, lanes):
    """Depth, normal (the gradient of the trilinear D) and colour of sixteen points to their rows of
    ``lanes``."""
    fx, fy, fz = f
    zero = splat(_ZERO)
    x00 = v[1] - v[0]
    x10 = v[3] - v[2]
    x01 = v[5] - v[4]
    x11 = v[7] - v[6]
    y00 = v[2] - v[0]
    y10 = v[3] - v[1]
    y01 = v[6] - v[4]
    y11 = v[7] - v[5]
    z00 = v[4] - v[0]
    z10 = v[5] - v[1]
    z01 = v[6] - v[2]
    z11 = v[7] - v[3]
    nx = _bilinear(x00, x10, x01, x11, fy, fz)
    ny = _bilinear(y00, y10, y01, y11, fx, fz)
    nz = _bilinear(z00, z10, z01, z11, fx, fy)
    length = maximum(sqrt(nx * nx + ny * ny + nz * nz), splat(f32(1e-12)))
    store(lanes[_DEPTH], 0, select(whole, z, zero))
    store(lanes[_NORMAL], 0, select(whole, nx / length, zero))
    store(lanes[_NORMAL + 1], 0, select(whole, ny / length, zero))
    store(lanes[_NORMAL + 2], 0, select(whole, nz / length, zero))
    for c in range(3):
        plane = splat_int(int32(VOXELS_PER_BLOCK * c))
        colours = (
            _colour(C, at[0], plane, whole),
            _colour(C, at[1], plane, whole),
            _colour(C, at[2], plane, whole),
            _colour(C, at[3], plane, whole),
            _colour(C, at[4], plane, whole),
            _colour(C, at[5], plane, whole),
            _colour(C, at[6], plane, whole),
            _colour(C, at[7], plane, whole),
        )
        store(lanes[_RGB + c], 0, select(whole, blend(colours, f), zero))


@njit(cache=True, error_model="numpy")
def _colour(C, at, plane, whole):
    row = at >> splat_int(int32(_BITS_OF_VOXEL))
    number = at & splat_int(int32(VOXELS_PER_BLOCK - 1))
    return gather(
        C, row * splat_int(int32(3 * VOXELS_PER_BLOCK)) + number + plane, whole, splat(_ZERO)
    )


@njit(cache=True, error_model="numpy")
def _bilinear(a, b, c, d, s, t):
    low = a + (b - a) * s
    high = c + (d - c) * s
    return low + (high - low) * t
