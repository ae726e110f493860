"""March rays to the surface, four by four at a time: steps and tests are the reference's."""

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

from ..runtime.arguments import BlockTable, lens_of, parts, ray_slopes
from ..runtime.numba.launch import launching, scratch
from ..runtime.numba.simd import absolute, any_lane, either, floor, load, maximum, minimum, select, splat, sqrt, store
from ..runtime.numba.simd_int import below, but_not, gather, gather_int, splat_int, truncate
from .in_view import CHUNKS_AT_ONCE, FAR_END, NEAR_END, look_up
from .trilinear import Blocks, Marked, Rays, Sizes, Unmarked, blend, cells, interpolate, leaves, values

f32 = np.float32
_ZERO, _HALF, _ONE = f32(0.0), f32(0.5), f32(1.0)
_STEP, _CLOSE = f32(STEP), f32(CLOSE_VOXELS)
_SMALL = f32(1e-9)
_INFINITE = f32(np.inf)
_MARGIN = f32(0.01)

TILE_PX = 8
"""Edge of the picture tiles whose rays start together, pixels: a multiple of 4."""

_DEPTH, _NORMAL, _RGB = 0, 1, 4
"""Rows of what sixteen rays bring back; normal and colour take three rows each."""
_LANE_ROWS = 7

_BITS_OF_VOXEL = VOXELS_PER_BLOCK.bit_length() - 1
"""Of a voxel's place in the pool, those that number it within its block."""


def raycast(volume: TsdfVolume, camera: Camera, T_WC: Tensor) -> RaycastOutput:
    """See ``gsfusion_nb.tsdf.raycast``."""
    lookup = volume.index.table
    if volume.D.dtype != torch.float32 or volume.device.type != "cpu" or lookup is None:
        return reference.reference(volume, camera, T_WC)
    depth, normal, rgb = (torch.empty(camera.height, camera.width, *n) for n in ((), (3,), (3,)))
    x, y = ray_slopes(camera)
    pose = T_WC.detach().cpu()
    rays = Rays(
        x=_in_fours(x).tile(1, 4).numpy(),
        y=_in_fours(y).repeat_interleave(4, 1).numpy(),
        T_WC=pose.to(torch.float32).numpy(),
    )
    lens, size = lens_of(camera, f32), (camera.height, camera.width)
    config = volume.config
    exact = Sizes(voxel=config.voxel_size_m, truncation=config.truncation_m, block=volume.block_size_m)
    sizes = Sizes(*(f32(length) for length in exact))
    rows, low, blocks = lookup
    table = BlockTable(rows=rows.numpy(), low=low.numpy().astype(np.int32), size=np.array(blocks, np.int32))
    D, W, colours = (t.view(-1).numpy() for t in (volume.D, volume.W, volume.rgb_planes))
    blocks = Blocks(coords=volume.block_coords.numpy(), D=D, W=W)
    T_CW = se3.inverse(pose.double()).numpy()
    spans = np.empty((parts(camera.height, TILE_PX), parts(camera.width, TILE_PX), 2), np.float32)
    with launching():
        copy = scratch("raycast", D.size)
        with parallel_chunksize(CHUNKS_AT_ONCE):
            copied = look_up(blocks, T_CW, lens, exact, size, TILE_PX, copy, spans)
        field = Marked(copy) if copied else Unmarked(D, W)
        with parallel_chunksize(spans.shape[1]):  # a row of tiles: neighbours meet the same voxels
            _march(table, field, colours, rays, sizes, spans, TILE_PX, depth.numpy(), normal.numpy(), rgb.numpy())
    return RaycastOutput(depth_m=depth, normal_W=normal, rgb=rgb)


def _in_fours(slopes: Tensor) -> Tensor:
    """Four slopes a row; the last one again where the picture ends within a row."""
    missing = -len(slopes) % 4
    return torch.cat([slopes, slopes[-1:].expand(missing)]).view(-1, 4)


@njit(inline="always")
def _to_wall(p, forward, per_block, inv_side):
    """Depth to add to leave, along one axis, the blocks that hold sixteen points."""
    inside = p * inv_side
    done = inside - floor(inside)
    return select(forward, splat(_ONE) - done, done) * per_block


@njit(cache=True, error_model="numpy")
def _crossing(table, field, origin, direction, sizes, span, alive):
    """Depths on either side of the first change from free to inside along sixteen rays, D there, and where it is."""
    rows, low, size = table.rows, table.low, table.size
    ox, oy, oz = origin
    dx, dy, dz = direction
    zero, one, infinite, small = splat(_ZERO), splat(_ONE), splat(_INFINITE), splat(_SMALL)
    voxel, truncation, side = splat(sizes.voxel), splat(sizes.truncation), splat(sizes.block)
    inv_voxel, inv_side = one / voxel, one / side
    reach, close_by, margin = splat(_STEP) * truncation, splat(_CLOSE) * voxel, splat(_MARGIN) * voxel
    three, seven, nowhere = splat_int(int32(3)), splat_int(int32(7)), splat_int(int32(-1))
    eight, sixty_four, block = splat_int(int32(8)), splat_int(int32(64)), splat_int(int32(VOXELS_PER_BLOCK))
    nx, ny, nz = splat_int(int32(size[0])), splat_int(int32(size[1])), splat_int(int32(size[2]))
    ny_nz = splat_int(int32(size[1] * size[2]))
    lx, ly, lz = splat_int(low[0]), splat_int(low[1]), splat_int(low[2])
    per_m = one / sqrt(dx * dx + dy * dy + dz * dz)
    per_x, per_y, per_z = (
        side / maximum(absolute(dx), small), side / maximum(absolute(dy), small), side / maximum(absolute(dz), small)
    )  # fmt: skip
    to_x, to_y, to_z = dx > zero, dy > zero, dz > zero
    z_start, z_end = span
    z, z_end = splat(z_start), splat(z_end)
    found = but_not(alive, alive)
    was_free, was_inside = found, found
    z_before, D_before = z, one
    z0, z1, D0, D1 = z, z, one, zero - one
    while any_lane(alive):
        px, py, pz = ox + dx * z, oy + dy * z, oz + dz * z
        i, j, k = truncate(floor(px * inv_voxel)), truncate(floor(py * inv_voxel)), truncate(floor(pz * inv_voxel))
        X, Y, Z = (i >> three) - lx, (j >> three) - ly, (k >> three) - lz
        row = gather_int(rows, X * ny_nz + Y * nz + Z, alive & below(X, nx) & below(Y, ny) & below(Z, nz), nowhere)
        allocated = row >= splat_int(int32(0))
        here, step = infinite, voxel * per_m
        if any_lane(allocated):
            at = row * block + (i & seven) * sixty_four + (j & seven) * eight + (k & seven)
            here = values(field, at, allocated)
            observed = here < infinite
            close = observed & (absolute(here) * truncation < close_by)
            if any_lane(close):
                smooth, whole = interpolate(table, field, (px, py, pz), inv_voxel, close)
                here = select(whole, smooth, here)
            step = select(observed, maximum(reach * absolute(here), voxel), voxel) * per_m
        outside = but_not(alive, allocated)
        if any_lane(outside):
            ahead = minimum(
                minimum(_to_wall(px, to_x, per_x, inv_side), _to_wall(py, to_y, per_y, inv_side)),
                _to_wall(pz, to_z, per_z, inv_side),
            )
            step = select(outside, ahead + margin, step)
        observed = here < infinite
        free, inside = observed & (here >= zero), observed & (zero > here)
        crossing = inside & was_free
        found = either(found, crossing)
        z0, z1 = select(crossing, z_before, z0), select(crossing, z, z1)
        D0, D1 = select(crossing, D_before, D0), select(crossing, here, D1)
        ahead = z + step
        alive = but_not(but_not(alive, crossing), free & was_inside) & (ahead < z_end)
        z_before, D_before = z, here
        was_free, was_inside = free & alive, inside & alive
        z = select(alive, ahead, z)
    return (z0, z1, D0, D1), found


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
def _refined(table, field, origin, direction, voxel, bracket, found):
    """Depth where D is zero on sixteen rays, between two depths on either side of the surface: the secant method.

    And the voxels around the points there, as of ``cells``, with their places between them. The points move so little
    that the voxels are seldom looked up again.
    """
    z0, z1, D0, D1 = bracket
    zero, inv_voxel = splat(_ZERO), splat(_ONE) / voxel
    z = z0 + (z1 - z0) * (D0 / (D0 - D1))
    px, py, pz = _in_voxels(origin, direction, z, inv_voxel)
    v, at, whole, corner = cells(table, field, px, py, pz, found)
    for _ in range(REFINEMENTS):
        here = blend(v, (px - corner[0], py - corner[1], pz - corner[2]))
        before, behind = whole & (here >= zero), whole & (zero > here)
        z0, D0 = select(before, z, z0), select(before, here, D0)
        z1, D1 = select(behind, z, z1), select(behind, here, D1)
        z = z0 + (z1 - z0) * (D0 / (D0 - D1))
        px, py, pz = _in_voxels(origin, direction, z, inv_voxel)
        if leaves(corner, px, py, pz, found):
            v, at, whole, corner = cells(table, field, px, py, pz, found)
    return z, v, at, (px - corner[0], py - corner[1], pz - corner[2]), whole


@njit(parallel=True, cache=True, error_model="numpy")
def _march(table, field, C, rays, sizes, spans, tile_px, depth, normal, rgb):
    """Fill the three pictures, four by four rays at a time; zero where no ray meets a surface observed on all sides."""
    T = rays.T_WC
    height, width = depth.shape
    ny, nx = spans.shape[0], spans.shape[1]
    packets = tile_px // 4
    for tile in prange(ny * nx):
        ti, tj = int64(tile) // nx, int64(tile) % nx
        lanes = np.empty((_LANE_ROWS, 16), np.float32)
        origin = (splat(T[0, 3]), splat(T[1, 3]), splat(T[2, 3]))
        span = (spans[ti, tj, NEAR_END], spans[ti, tj, FAR_END])
        alive = splat(span[1]) > splat(span[0])
        for part in range(packets * packets):
            i, j = ti * packets + part // packets, tj * packets + part % packets
            v0, u0 = 4 * i, 4 * j
            if v0 >= height or u0 >= width:
                continue
            sx, sy = load(rays.x[j], 0), load(rays.y[i], 0)
            dx = splat(T[0, 0]) * sx + splat(T[0, 1]) * sy + splat(T[0, 2])
            dy = splat(T[1, 0]) * sx + splat(T[1, 1]) * sy + splat(T[1, 2])
            dz = splat(T[2, 0]) * sx + splat(T[2, 1]) * sy + splat(T[2, 2])
            bracket, found = _crossing(table, field, origin, (dx, dy, dz), sizes, span, alive)
            if any_lane(found):
                z, values, at, f, whole = _refined(
                    table, field, origin, (dx, dy, dz), splat(sizes.voxel), bracket, found
                )
                _surface_into(values, at, f, whole, z, C, lanes)
            else:
                lanes[:] = _ZERO
            for k in range(16):
                v, u = v0 + k // 4, u0 + k % 4
                if v < height and u < width:
                    depth[v, u] = lanes[_DEPTH, k]
                    for c in range(3):
                        normal[v, u, c], rgb[v, u, c] = lanes[_NORMAL + c, k], lanes[_RGB + c, k]


@njit(cache=True, error_model="numpy")
def _surface_into(v, at, f, whole, z, C, lanes):
    """Depth, normal (the gradient of the trilinear D) and colour of sixteen points to their rows of ``lanes``."""
    fx, fy, fz = f
    zero = splat(_ZERO)
    x00, x10, x01, x11 = v[1] - v[0], v[3] - v[2], v[5] - v[4], v[7] - v[6]
    y00, y10, y01, y11 = v[2] - v[0], v[3] - v[1], v[6] - v[4], v[7] - v[5]
    z00, z10, z01, z11 = v[4] - v[0], v[5] - v[1], v[6] - v[2], v[7] - v[3]
    nx, ny, nz = (
        _bilinear(x00, x10, x01, x11, fy, fz),
        _bilinear(y00, y10, y01, y11, fx, fz),
        _bilinear(z00, z10, z01, z11, fx, fy),
    )
    length = maximum(sqrt(nx * nx + ny * ny + nz * nz), splat(f32(1e-12)))
    store(lanes[_DEPTH], 0, select(whole, z, zero))
    store(lanes[_NORMAL], 0, select(whole, nx / length, zero))
    store(lanes[_NORMAL + 1], 0, select(whole, ny / length, zero))
    store(lanes[_NORMAL + 2], 0, select(whole, nz / length, zero))
    for c in range(3):
        plane = splat_int(int32(VOXELS_PER_BLOCK * c))
        colours = (
            _colour(C, at[0], plane, whole), _colour(C, at[1], plane, whole),
            _colour(C, at[2], plane, whole), _colour(C, at[3], plane, whole),
            _colour(C, at[4], plane, whole), _colour(C, at[5], plane, whole),
            _colour(C, at[6], plane, whole), _colour(C, at[7], plane, whole),
        )  # fmt: skip
        store(lanes[_RGB + c], 0, select(whole, blend(colours, f), zero))


@njit(cache=True, error_model="numpy")
def _colour(C, at, plane, whole):
    row, number = at >> splat_int(int32(_BITS_OF_VOXEL)), at & splat_int(int32(VOXELS_PER_BLOCK - 1))
    return gather(C, row * splat_int(int32(3 * VOXELS_PER_BLOCK)) + number + plane, whole, splat(_ZERO))


@njit(cache=True, error_model="numpy")
def _bilinear(a, b, c, d, s, t):
    low, high = a + (b - a) * s, c + (d - c) * s
    return low + (high - low) * t
