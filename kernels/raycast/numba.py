"""March rays to the surface, four by four at a time: steps and tests are the reference's."""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

import math
from typing import NamedTuple

import numpy as np
import torch
from numba import int32, int64, njit, prange
from torch import Tensor

from gsfusion_nb.constants import VOXELS_PER_BLOCK
from gsfusion_nb.geometry import se3
from gsfusion_nb.tsdf.raycast import CLOSE_VOXELS, REFINEMENTS, STEP, RaycastOutput
from gsfusion_nb.tsdf.raycast import raycast as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Camera

from ..runtime.block_table import BlockTable
from ..runtime.lens import lens_of
from ..runtime.numba.launch import launching
from ..runtime.numba.simd import absolute, any_lane, either, floor, load, maximum, minimum, select, splat, sqrt, store
from ..runtime.numba.simd_int import below, but_not, gather, gather_int, select_int, splat_int, truncate
from ..runtime.slopes import ray_slopes

f32 = np.float32
_ZERO, _HALF, _ONE = f32(0.0), f32(0.5), f32(1.0)
_STEP, _CLOSE = f32(STEP), f32(CLOSE_VOXELS)
_NEAR = f32(0.01)
_SMALL = f32(1e-9)
_INFINITE = f32(np.inf)
_MARGIN = f32(0.01)

TILE_PX = 16
"""Edge of the picture tiles whose rays start together, pixels."""

_NEAR_END, _FAR_END = range(2)
"""Columns of the depths between which a tile's rays can meet a block."""

_X, _Y, _STARTS, _DEPTH = range(4)
_NORMAL, _RGB = 4, 7
"""Rows of what sixteen rays bring along and bring back: slopes, whether there is anything to meet, then the results;
normal and colour take three rows each."""
_LANE_ROWS = 10

_BITS_OF_VOXEL = VOXELS_PER_BLOCK.bit_length() - 1
"""Of a voxel's place in the pool, those that number it within its block."""


class Rays(NamedTuple):
    """x / z of every column and y / z of every row of pixels, and the pose [4, 4], float32."""

    x: np.ndarray
    y: np.ndarray
    T_WC: np.ndarray


class Sizes(NamedTuple):
    """Edge of a voxel, truncation distance and edge of a block, metres."""

    voxel: float | np.float32
    truncation: float | np.float32
    block: float | np.float32


def raycast(volume: TsdfVolume, camera: Camera, T_WC: Tensor) -> RaycastOutput:
    """See ``gsfusion_nb.tsdf.raycast``."""
    lookup = volume.index.table
    if volume.D.dtype != torch.float32 or volume.device.type != "cpu" or lookup is None:
        return reference.reference(volume, camera, T_WC)
    depth, normal, rgb = (torch.empty(camera.height, camera.width, *n) for n in ((), (3,), (3,)))
    x, y = ray_slopes(camera)
    pose = T_WC.detach().cpu()
    rays = Rays(x=x.numpy(), y=y.numpy(), T_WC=pose.to(torch.float32).numpy())
    lens, size = lens_of(camera, f32), (camera.height, camera.width)
    config = volume.config
    exact = Sizes(voxel=config.voxel_size_m, truncation=config.truncation_m, block=volume.block_size_m)
    sizes = Sizes(*(f32(length) for length in exact))
    rows, low, blocks = lookup
    table = BlockTable(rows=rows.numpy(), low=low.numpy().astype(np.int32), size=np.array(blocks, np.int32))
    D, W, colours = (t.view(-1).numpy() for t in (volume.D, volume.W, volume.rgb_planes))
    coords, T_CW = volume.block_coords.numpy(), se3.inverse(pose.double()).numpy()
    with launching():
        spans = _depth_spans(coords, T_CW, exact.block, lens, size)
        field = np.empty(D.size, np.float32)
        _observed_field(coords, D, W, T_CW, lens, exact, size, field)
        _march(table, field, colours, rays, sizes, spans, depth.numpy(), normal.numpy(), rgb.numpy())
    return RaycastOutput(depth_m=depth, normal_W=normal, rgb=rgb)


@njit(cache=True, error_model="numpy")
def _depth_spans(coords, T_CW, side, lens, size):
    """Depths between which the rays of each tile of pixels can meet a block. [rows, columns, 2]"""
    height, width = size
    ny, nx = (height + TILE_PX - 1) // TILE_PX, (width + TILE_PX - 1) // TILE_PX
    spans = np.empty((ny, nx, 2), np.float32)
    spans[:, :, _NEAR_END] = np.inf
    spans[:, :, _FAR_END] = _ZERO
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
                spans[i, j, _NEAR_END] = min(spans[i, j, _NEAR_END], max(low_z, _ZERO))
                spans[i, j, _FAR_END] = max(spans[i, j, _FAR_END], high_z)
    return spans


@njit(parallel=True, cache=True, error_model="numpy")
def _observed_field(coords, D, W, T_CW, lens, sizes, size, field):
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


@njit(cache=True, error_model="numpy")
def _corner(rows, field, cell, number, moved, inside, row, wanted):
    """Value and position of one corner of sixteen cells; ``moved`` are those where it lies in another block."""
    if any_lane(moved):
        nowhere = splat_int(int32(-1))
        row = select_int(moved, gather_int(rows, cell, moved & inside, nowhere), row)
    at = row * splat_int(int32(VOXELS_PER_BLOCK)) + number
    return gather(field, at, wanted & (row >= splat_int(int32(0))), splat(_INFINITE)), at


@njit(cache=True, error_model="numpy")
def _cells(table, field, px, py, pz, wanted):
    """The eight voxels around sixteen points: their values (infinite where not observed) and positions.

    Points are in voxels, less a half. Also returns where they lie in their cells, and which cells are observed whole.
    """
    rows, low, size = table.rows, table.low, table.size
    one, seven, three, zero = splat_int(int32(1)), splat_int(int32(7)), splat_int(int32(3)), splat_int(int32(0))
    bx, by, bz = floor(px), floor(py), floor(pz)
    fx, fy, fz = px - bx, py - by, pz - bz
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
    return (v0, v1, v2, v3, v4, v5, v6, v7), (a0, a1, a2, a3, a4, a5, a6, a7), (fx, fy, fz), whole


@njit(cache=True, error_model="numpy")
def _blend(v, f):
    """Trilinear interpolation between corners x + 2 y + 4 z."""
    fx, fy, fz = f
    y0, y1 = v[0] + (v[1] - v[0]) * fx, v[2] + (v[3] - v[2]) * fx
    y2, y3 = v[4] + (v[5] - v[4]) * fx, v[6] + (v[7] - v[6]) * fx
    z0, z1 = y0 + (y1 - y0) * fy, y2 + (y3 - y2) * fy
    return z0 + (z1 - z0) * fz


@njit(cache=True, error_model="numpy")
def _interpolate(table, field, point, voxel, wanted):
    """Trilinear D at sixteen world points, and where all eight voxels around them have been observed."""
    half = splat(_HALF)
    v, _, f, whole = _cells(
        table, field, point[0] / voxel - half, point[1] / voxel - half, point[2] / voxel - half, wanted
    )
    return _blend(v, f), whole


@njit(cache=True, error_model="numpy")
def _to_exit(p, d, side):
    """Depth to add to leave, along one axis, the blocks that hold sixteen points."""
    inside = p / side
    done = inside - floor(inside)
    ahead = select(d > splat(_ZERO), splat(_ONE) - done, done)
    return ahead * side / maximum(absolute(d), splat(_SMALL))


@njit(cache=True, error_model="numpy")
def _crossing(table, field, origin, direction, sizes, span, alive):
    """Depth of the first change from free to inside along sixteen rays, refined, and which of them have one."""
    rows, low, size = table.rows, table.low, table.size
    ox, oy, oz = origin
    dx, dy, dz = direction
    zero, one, infinite = splat(_ZERO), splat(_ONE), splat(_INFINITE)
    voxel, truncation, side = splat(sizes.voxel), splat(sizes.truncation), splat(sizes.block)
    reach, close_by, margin = splat(_STEP) * truncation, splat(_CLOSE) * voxel, splat(_MARGIN) * voxel
    three, seven, nowhere = splat_int(int32(3)), splat_int(int32(7)), splat_int(int32(-1))
    eight, sixty_four, block = splat_int(int32(8)), splat_int(int32(64)), splat_int(int32(VOXELS_PER_BLOCK))
    nx, ny, nz = splat_int(int32(size[0])), splat_int(int32(size[1])), splat_int(int32(size[2]))
    lx, ly, lz = splat_int(low[0]), splat_int(low[1]), splat_int(low[2])
    per_m = one / sqrt(dx * dx + dy * dy + dz * dz)
    z_start, z_end = span
    z, z_end = splat(z_start), splat(z_end)
    found = but_not(alive, alive)
    was_free, was_inside = found, found
    z_before, D_before = z, one
    z0, z1, D0, D1 = z, z, one, zero - one
    while any_lane(alive):
        px, py, pz = ox + dx * z, oy + dy * z, oz + dz * z
        i, j, k = truncate(floor(px / voxel)), truncate(floor(py / voxel)), truncate(floor(pz / voxel))
        X, Y, Z = (i >> three) - lx, (j >> three) - ly, (k >> three) - lz
        row = gather_int(rows, (X * ny + Y) * nz + Z, alive & below(X, nx) & below(Y, ny) & below(Z, nz), nowhere)
        allocated = row >= splat_int(int32(0))
        at = row * block + (i & seven) * sixty_four + (j & seven) * eight + (k & seven)
        here = gather(field, at, allocated, infinite)
        observed = here < infinite
        close = observed & (absolute(here) * truncation < close_by)
        if any_lane(close):
            smooth, whole = _interpolate(table, field, (px, py, pz), voxel, close)
            here = select(whole, smooth, here)
        free, inside = observed & (here >= zero), observed & (zero > here)
        step = select(observed, maximum(reach * absolute(here), voxel), voxel) * per_m
        outside = but_not(alive, allocated)
        if any_lane(outside):
            ahead = minimum(minimum(_to_exit(px, dx, side), _to_exit(py, dy, side)), _to_exit(pz, dz, side))
            step = select(outside, ahead + margin, step)
        crossing = inside & was_free
        found = either(found, crossing)
        z0, z1 = select(crossing, z_before, z0), select(crossing, z, z1)
        D0, D1 = select(crossing, D_before, D0), select(crossing, here, D1)
        ahead = z + step
        alive = but_not(but_not(alive, crossing), free & was_inside) & (ahead < z_end)
        z_before, D_before = z, here
        was_free, was_inside = free & alive, inside & alive
        z = select(alive, ahead, z)
    z = z0 + (z1 - z0) * (D0 / (D0 - D1))
    if any_lane(found):
        for _ in range(REFINEMENTS):
            here, whole = _interpolate(table, field, (ox + dx * z, oy + dy * z, oz + dz * z), voxel, found)
            before, behind = whole & (here >= zero), whole & (zero > here)
            z0, D0 = select(before, z, z0), select(before, here, D0)
            z1, D1 = select(behind, z, z1), select(behind, here, D1)
            z = z0 + (z1 - z0) * (D0 / (D0 - D1))
    return z, found


@njit(parallel=True, cache=True, error_model="numpy")
def _march(table, field, C, rays, sizes, spans, depth, normal, rgb):
    """Fill the three pictures, four by four rays at a time; zero where no ray meets a surface observed on all sides."""
    x, y, T = rays.x, rays.y, rays.T_WC
    height, width = depth.shape
    ny, nx = spans.shape[0], spans.shape[1]
    for task in prange(ny * nx):
        ti, tj = int64(task) // nx, int64(task) % nx
        lanes = np.empty((_LANE_ROWS, 16), np.float32)
        zero, half, voxel = splat(_ZERO), splat(_HALF), splat(sizes.voxel)
        ox, oy, oz = splat(T[0, 3]), splat(T[1, 3]), splat(T[2, 3])
        for part in range(TILE_PX * TILE_PX // 16):
            v0 = ti * TILE_PX + part // (TILE_PX // 4) * 4
            u0 = tj * TILE_PX + part % (TILE_PX // 4) * 4
            if v0 >= height or u0 >= width:
                continue
            for k in range(16):
                v, u = v0 + k // 4, u0 + k % 4
                lanes[_X, k], lanes[_Y, k] = x[min(u, width - 1)], y[min(v, height - 1)]
                starts = v < height and u < width and spans[ti, tj, _NEAR_END] < spans[ti, tj, _FAR_END]
                lanes[_STARTS, k] = _ONE if starts else _ZERO
            sx, sy = load(lanes[_X], 0), load(lanes[_Y], 0)
            dx = splat(T[0, 0]) * sx + splat(T[0, 1]) * sy + splat(T[0, 2])
            dy = splat(T[1, 0]) * sx + splat(T[1, 1]) * sy + splat(T[1, 2])
            dz = splat(T[2, 0]) * sx + splat(T[2, 1]) * sy + splat(T[2, 2])
            alive = load(lanes[_STARTS], 0) > zero
            span = (spans[ti, tj, _NEAR_END], spans[ti, tj, _FAR_END])
            z, found = _crossing(table, field, (ox, oy, oz), (dx, dy, dz), sizes, span, alive)
            px, py, pz = (ox + dx * z) / voxel - half, (oy + dy * z) / voxel - half, (oz + dz * z) / voxel - half
            values, at, f, whole = _cells(table, field, px, py, pz, found)
            _surface_into(values, at, f, whole, z, C, lanes)
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
        store(lanes[_RGB + c], 0, select(whole, _blend(colours, f), zero))


@njit(cache=True, error_model="numpy")
def _colour(C, at, plane, whole):
    row, number = at >> splat_int(int32(_BITS_OF_VOXEL)), at & splat_int(int32(VOXELS_PER_BLOCK - 1))
    return gather(C, row * splat_int(int32(3 * VOXELS_PER_BLOCK)) + number + plane, whole, splat(_ZERO))


@njit(cache=True, error_model="numpy")
def _bilinear(a, b, c, d, s, t):
    low, high = a + (b - a) * s, c + (d - c) * s
    return low + (high - low) * t
