"""Fold a frame into the volume: one pass over the blocks to find what it can observe, one over their voxels.

A block is 32 vectors of two rows of eight voxels. Its homogeneous pixel coordinates are one corner plus 512 offsets
that all blocks share, as in the reference, whose roundings are repeated here: distance "z" gives the same bits.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

import numpy as np
import torch
from numba import int32, njit, prange, uint32, uint64

from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.constants import BLOCK_VOXELS, VOXELS_PER_BLOCK
from gsfusion_nb.geometry import se3
from gsfusion_nb.tsdf.integrate import INT16_ONE
from gsfusion_nb.tsdf.integrate import fuse_frame_ as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Frame

from ..runtime.numba.launch import launching
from ..runtime.numba.simd import any_lane, load, maximum, minimum, select, splat, sqrt, store, times
from ..runtime.numba.simd_int import (
    byte_triples,
    count_lanes,
    first_byte,
    float_bits,
    gather,
    gather_pairs,
    prefetch,
    second_byte,
    splat_int,
    store_pairs,
    third_byte,
    truncate,
)

f32 = np.float32
_EPS = f32(1e-4)
_MISSING = f32(-1e9)
_ZERO, _ONE, _INFINITE = f32(0.0), f32(1.0), f32(np.inf)
_GREY_LEVELS = f32(255.0)
_AVERAGES = {"mean": 0, "eq9": 1, "int16": 2}
_INT16_ONE, _INT16_ULP = f32(INT16_ONE), f32(1.0 / INT16_ONE)
_ULP_IS_ONE = f32(2.0**23)
"""From here on float32 numbers are whole: adding and subtracting it rounds a smaller positive number."""

_TILE = 8
_CHUNK = 16
"""Blocks of one parallel task."""

_SCAN = 4
"""A block's picture is looked up on the level of the depth pyramid where it is less than this many tiles wide."""


_NO_FLOATS, _NO_BYTES = np.empty(0, np.float32), np.empty(0, np.uint8)


def fuse_frame_(volume: TsdfVolume, frame: Frame) -> int:
    """See ``gsfusion_nb.tsdf.integrate.fuse_frame_``."""
    if any(t.device.type != "cpu" for t in (frame.depth_m, volume.D)) or volume.D.dtype != torch.float32:
        return reference.reference(volume, frame)
    if not volume.n_blocks:
        return 0
    camera, config = frame.camera, volume.config
    T_CW = se3.inverse(frame.T_WC.detach().double()).numpy()
    # (U, V, Z) of a world point: one is added to the pixel so that a truncation towards zero finds it.
    K = np.array([[camera.fx, 0.0, camera.cx + 1], [0.0, camera.fy, camera.cy + 1], [0.0, 0.0, 1.0]])
    depth, colour = (t.detach().contiguous().numpy() for t in (frame.depth_m, frame.colour))
    levels, rgb = (colour.reshape(-1), _NO_FLOATS) if frame.is_8_bit else (_NO_BYTES, colour.reshape(-1))
    limits = np.array(
        [config.near_m, config.far_m, config.truncation_m, config.max_weight, config.voxel_size_m], np.float64
    )
    state = (volume.block_coords.numpy(), *(t.view(-1).numpy() for t in (volume.D, volume.W, volume.rgb_planes)))
    with launching():
        packed, pyramid = _packed(depth, levels, config.near_m)
        seen = np.zeros(volume.n_blocks, np.uint8)
        _observable(state[0], K @ T_CW[:3], T_CW[2], limits, depth.shape, pyramid, seen)
        rows = np.flatnonzero(seen).astype(np.int32)
        updated = np.zeros(-(-len(rows) // _CHUNK), np.int64)
        _fuse(rows, state, (packed, rgb), depth.shape, (T_CW, K), limits, _published(config), updated)
    return int(updated.sum())


def _published(config: TsdfConfig) -> tuple[bool, int]:
    """Whether distances are along the ray, and how they are averaged."""
    return config.sdf == "ray", _AVERAGES[config.average]


def _packed(depth: np.ndarray, colour: np.ndarray, near_m: float) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Depth bits and, if ``colour`` [H W 3] has any bytes, colour of every pixel in one word; a pyramid of depths.

    Unknown depth becomes ``_MISSING``. The pyramid holds the largest depth of tiles of 8, 16, 32 ... pixels, level
    after level in one array; with it come the offset, rows and columns of each level. [L, 3]
    """
    height, width = depth.shape
    levels = [(0, -(-height // _TILE), -(-width // _TILE))]
    while max(levels[-1][1:]) > 1:
        start, h, w = levels[-1]
        levels.append((start + h * w, (h + 1) // 2, (w + 1) // 2))
    packed, pyramid = np.empty(height * width, np.uint64), np.empty(levels[-1][0] + 1, np.float32)
    _pack(depth, colour, f32(near_m), np.array(levels), packed, pyramid)
    return packed, (pyramid, np.array(levels))


@njit(parallel=True, cache=True, error_model="numpy")
def _pack(depth, colour, near, levels, packed, pyramid):
    """See ``_packed``."""
    height, width = depth.shape
    h, w = levels[0, 1], levels[0, 2]
    flat_depth, has_bytes = depth.reshape(-1), len(colour) > 0
    for i in prange(h):
        column = np.full(w * _TILE + 16, _MISSING, np.float32)
        missing, zero, nearest, infinite = splat(_MISSING), splat(_ZERO), splat(near), splat(_INFINITE)
        for y in range(i * _TILE, min(height, i * _TILE + _TILE)):
            for x in range(0, width - 15, 16):
                at = y * width + x
                d = load(flat_depth, at)
                d = select((d > zero) & (d >= nearest) & (d < infinite), d, missing)
                store(column, x, maximum(load(column, x), d))
                store_pairs(packed, at, d, byte_triples(colour, 3 * at) if has_bytes else splat_int(int32(0)))
            for x in range(width - width % 16, width):
                d = depth[y, x]
                d = d if (d > _ZERO) & (d >= near) & (d < _INFINITE) else _MISSING
                column[x] = max(column[x], d)
                at, word = y * width + x, uint32(0)
                if has_bytes:
                    for c in range(3):
                        word |= uint32(colour[3 * at + c]) << uint32(8 * c)
                packed[at] = uint64(float_bits(d)) | uint64(word) << uint64(32)
        for j in range(w):
            most = _MISSING
            for x in range(j * _TILE, j * _TILE + _TILE):
                most = max(most, column[x])
            pyramid[i * w + j] = most
    for k in range(1, levels.shape[0]):
        below, fine_h, fine_w = levels[k - 1, 0], levels[k - 1, 1], levels[k - 1, 2]
        for i in range(levels[k, 1]):
            for j in range(levels[k, 2]):
                most = _MISSING
                for y in range(2 * i, min(2 * i + 2, fine_h)):
                    for x in range(2 * j, min(2 * j + 2, fine_w)):
                        most = max(most, pyramid[below + y * fine_w + x])
                pyramid[levels[k, 0] + i * levels[k, 2] + j] = most


@njit(parallel=True, cache=True, error_model="numpy")
def _observable(coords, M, axis_z, limits, size, pyramid, seen):
    """Set ``seen`` for the blocks with a voxel that may be observed: in view, not beyond ``far_m``, not hidden.

    M [3, 4]: homogeneous pixel coordinates (U, V, Z) of a world point. axis_z: third row of T_CW.
    """
    B = coords.shape[0]
    height, width = size
    far, truncation = limits[1], limits[2]
    side = BLOCK_VOXELS * limits[4]
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
                if high_u < 1.0 or high_v < 1.0 or low_u > width + 1 or low_v > height + 1:
                    continue
            box = (low_u - 1.0, high_u - 1.0, low_v - 1.0, high_v - 1.0)
            seen[i] = Z - half_z < _farthest(pyramid[0], pyramid[1], box, width, height) + truncation + 1e-5 * Z


@njit(cache=True, error_model="numpy")
def _farthest(pyramid, levels, box, width, height):
    """Largest known depth in a box of pixels (u low, u high, v low, v high)."""
    u0, u1 = int(max(box[0], 0.0)), int(min(box[1], width - 1.0))
    v0, v1 = int(max(box[2], 0.0)), int(min(box[3], height - 1.0))
    level, tile = 0, _TILE
    while level < levels.shape[0] - 1 and max(u1 // tile - u0 // tile, v1 // tile - v0 // tile) >= _SCAN:
        level, tile = level + 1, tile * 2
    start, columns = levels[level, 0], levels[level, 2]
    most = _MISSING
    for i in range(v0 // tile, v1 // tile + 1):
        for j in range(u0 // tile, u1 // tile + 1):
            most = max(most, pyramid[start + i * columns + j])
    return most


@njit(cache=True, error_model="numpy")
def _offsets(T_CW, K, voxel_size):
    """(U, V, Z) of the 512 voxel centres relative to their block's corner, planes of one array."""
    out = np.empty(3 * VOXELS_PER_BLOCK, np.float32)
    for n in range(VOXELS_PER_BLOCK):
        x, y, z = ((n >> 6) + 0.5) * voxel_size, ((n >> 3 & 7) + 0.5) * voxel_size, ((n & 7) + 0.5) * voxel_size
        X = T_CW[0, 0] * x + T_CW[0, 1] * y + T_CW[0, 2] * z
        Y = T_CW[1, 0] * x + T_CW[1, 1] * y + T_CW[1, 2] * z
        Z = T_CW[2, 0] * x + T_CW[2, 1] * y + T_CW[2, 2] * z
        out[n] = K[0, 0] * X + K[0, 2] * Z
        out[VOXELS_PER_BLOCK + n] = K[1, 1] * Y + K[1, 2] * Z
        out[2 * VOXELS_PER_BLOCK + n] = Z
    return out


@njit(cache=True, error_model="numpy")
def _as_published(D, d, W, W_k, average):
    """Averages "eq9" and "int16" of ``tsdf_update``."""
    if average == 1:
        return (D * W + d * W_k) / (W + W_k)
    unit, one = splat(_INT16_ONE), splat(_ONE)
    total = _rounded(D * unit) * (W_k - one) + _truncated(d * unit)
    return _truncated(total / W_k) * splat(_INT16_ULP)


@njit(cache=True, error_model="numpy")
def _rounded(x):
    """The whole numbers next to lanes of less than 2^22 in size."""
    shift = splat(_ULP_IS_ONE * f32(1.5))
    return (x + shift) - shift


@njit(cache=True, error_model="numpy")
def _truncated(x):
    """Lanes of less than 2^22 in size, rounded towards zero."""
    zero, one = splat(_ZERO), splat(_ONE)
    whole = _rounded(x)
    whole = select((x > zero) & (whole > x), whole - one, whole)
    return select((x < zero) & (whole < x), whole + one, whole)


@njit(parallel=True, cache=True, error_model="numpy")
def _fuse(rows, state, image, size, view, limits, published, updated):
    """Update the voxels of the blocks ``rows``; ``updated`` [tasks] takes the numbers of voxels observed.

    A task takes every n-th block, so that tasks cost about the same wherever the hidden blocks are.
    """
    coords, D, W, C = state
    T_CW, K = view
    packed, rgb = image
    along_ray, average = published
    offset = _offsets(T_CW, K, limits[4])
    height, width = size
    n_tasks = updated.shape[0]
    side = BLOCK_VOXELS * limits[4]
    for task in prange(n_tasks):
        zero, one, eps, missing = splat(_ZERO), splat(_ONE), splat(_EPS), splat(_MISSING)
        end_u, end_v = splat(f32(width + 1)), splat(f32(height + 1))
        stride, first_pixel, three = splat_int(np.int32(width)), splat_int(np.int32(width + 1)), splat_int(np.int32(3))
        grey_level = splat(_ONE / _GREY_LEVELS)
        behind, inv_truncation = splat(f32(-limits[2])), splat(f32(1.0 / limits[2]))
        most = splat(f32(limits[3]))
        fx, fy, cx, cy = splat(f32(1.0 / K[0, 0])), splat(f32(1.0 / K[1, 1])), splat(f32(K[0, 2])), splat(f32(K[1, 2]))
        count = 0
        for r in range(task, len(rows), n_tasks):
            row = rows[r]
            ahead = rows[min(r + n_tasks, len(rows) - 1)] * VOXELS_PER_BLOCK
            x, y, z = coords[row, 0] * side, coords[row, 1] * side, coords[row, 2] * side
            X = T_CW[0, 0] * x + T_CW[0, 1] * y + T_CW[0, 2] * z + T_CW[0, 3]
            Y = T_CW[1, 0] * x + T_CW[1, 1] * y + T_CW[1, 2] * z + T_CW[1, 3]
            Zc = T_CW[2, 0] * x + T_CW[2, 1] * y + T_CW[2, 2] * z + T_CW[2, 3]
            corner_u, corner_v = splat(f32(K[0, 0] * X + K[0, 2] * Zc)), splat(f32(K[1, 1] * Y + K[1, 2] * Zc))
            corner_z = splat(f32(Zc))
            for o in range(0, VOXELS_PER_BLOCK, 16):
                prefetch(W, ahead + o)
                prefetch(D, ahead + o)
                away = corner_z + load(offset, 2 * VOXELS_PER_BLOCK + o)
                inv_z = one / away
                u = times(corner_u + load(offset, o), inv_z)
                v = times(corner_v + load(offset, VOXELS_PER_BLOCK + o), inv_z)
                inside = (u >= one) & (u < end_u) & (v >= one) & (v < end_v) & (away >= eps)
                if not any_lane(inside):
                    continue
                pixel = truncate(select(inside, v, one)) * stride + truncate(select(inside, u, one)) - first_pixel
                measured, colour = gather_pairs(packed, pixel, inside, missing)
                sdf = measured - away
                if along_ray:
                    slope_u, slope_v = times(u - cx, fx), times(v - cy, fy)
                    sdf = sdf * sqrt(one + slope_u * slope_u + slope_v * slope_v)
                observed = sdf > behind
                if not any_lane(observed):
                    continue
                count += count_lanes(observed)
                at = row * VOXELS_PER_BLOCK + o
                W_old, D_old = load(W, at), load(D, at)
                W_new = select(observed, minimum(W_old + one, most), W_old)
                step = select(observed, one / W_new, zero)
                d = maximum(minimum(times(sdf, inv_truncation), one), zero - one)
                store(W, at, W_new)
                if average == 0:
                    store(D, at, D_old + select(observed, step * (d - D_old), zero))
                else:
                    store(D, at, select(observed, _as_published(D_old, d, W_old, W_new, average), D_old))
                for c in range(3):
                    prefetch(C, 3 * ahead + c * VOXELS_PER_BLOCK + o)
                c0 = row * 3 * VOXELS_PER_BLOCK + o
                c1, c2 = c0 + VOXELS_PER_BLOCK, c0 + 2 * VOXELS_PER_BLOCK
                if rgb.shape[0] > 0:
                    red, green, blue = (
                        pixel * three,
                        pixel * three + splat_int(int32(1)),
                        pixel * three + splat_int(int32(2)),
                    )
                    store(C, c0, load(C, c0) + step * (gather(rgb, red, observed, zero) - load(C, c0)))
                    store(C, c1, load(C, c1) + step * (gather(rgb, green, observed, zero) - load(C, c1)))
                    store(C, c2, load(C, c2) + step * (gather(rgb, blue, observed, zero) - load(C, c2)))
                else:
                    store(C, c0, load(C, c0) + step * (first_byte(colour) * grey_level - load(C, c0)))
                    store(C, c1, load(C, c1) + step * (second_byte(colour) * grey_level - load(C, c1)))
                    store(C, c2, load(C, c2) + step * (third_byte(colour) * grey_level - load(C, c2)))
        updated[task] = count
