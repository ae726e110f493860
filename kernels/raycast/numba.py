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

import numpy as np
import torch
from numba import int32, int64, njit, parallel_chunksize, prange
from torch import Tensor

from gsfusion_nb.geometry import se3
from gsfusion_nb.tsdf.block_pool import VOXELS_PER_BLOCK
from gsfusion_nb.tsdf.raycast import CLOSE_VOXELS, REFINEMENTS, STEP, RaycastOutput
from gsfusion_nb.tsdf.raycast import raycast as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Camera

from ..runtime.arguments import (
    BlockTable,
    lens_of,
    parts,
    ray_slopes,
)
from ..runtime.numba.blocks import blocks_in_view
from ..runtime.numba.launch import launching, scratch
from ..runtime.numba.simd import (
    absolute,
    any_lane,
    but_not,
    either,
    floor,
    gather,
    load,
    maximum,
    minimum,
    select,
    splat,
    splat_int,
    sqrt,
    store,
    truncate,
)
from .cells import (
    BITS_OF_VOXEL,
    Marked,
    Near,
    Sizes,
    Unmarked,
    at_places,
    blend,
    cells,
    interpolate,
    leaves,
    place,
    rows_of,
    values,
)
from .reach import BLOCKS_AT_ONCE, FAR_END, NEAR_BLOCKS, NEAR_END, look_up, near_blocks

f32 = np.float32
_ZERO = f32(0.0)
_HALF = f32(0.5)
_ONE = f32(1.0)
_STEP = f32(STEP)
_CLOSE = f32(CLOSE_VOXELS)
_SMALL = f32(1e-9)
_INFINITE = f32(np.inf)
_MARGIN = f32(0.01)


TILE_PX = 8
"""Edge of the picture tiles whose rays start together, pixels: a multiple of 4."""

_DEPTH = 0
_NORMAL = 1
_RGB = 4
"""Rows of what sixteen rays bring back; normal and colour take three rows each."""
_LANE_ROWS = 7


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
    row = at >> splat_int(int32(BITS_OF_VOXEL))
    number = at & splat_int(int32(VOXELS_PER_BLOCK - 1))
    return gather(
        C, row * splat_int(int32(3 * VOXELS_PER_BLOCK)) + number + plane, whole, splat(_ZERO)
    )


@njit(cache=True, error_model="numpy")
def _bilinear(a, b, c, d, s, t):
    low = a + (b - a) * s
    high = c + (d - c) * s
    return low + (high - low) * t
