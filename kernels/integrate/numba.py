"""Fold a frame into the volume: one pass over the blocks to find what it can observe, one over their voxels.

A block is 32 vectors of two rows of eight voxels. Its homogeneous pixel coordinates are one corner plus 512 offsets
that all blocks share, as in the reference, whose roundings are repeated here: distance "z" gives the same bits.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

from typing import NamedTuple

import numpy as np
import torch
from numba import int32, njit, prange, uint32, uint64

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
_MEAN, _EQ9, _INT16 = range(3)
_AVERAGES = {"mean": _MEAN, "eq9": _EQ9, "int16": _INT16}
_INT16_ONE, _INT16_ULP = f32(INT16_ONE), f32(1.0 / INT16_ONE)
_ULP_IS_ONE = f32(2.0**23)
"""From here on float32 numbers are whole: adding and subtracting it rounds a smaller positive number."""

_TILE = 8
_CHUNK = 16
"""Blocks of one parallel task."""

_SCAN = 4
"""A block's picture is looked up on the level of the depth pyramid where it is less than this many tiles wide."""


_NO_FLOATS, _NO_BYTES = np.empty(0, np.float32), np.empty(0, np.uint8)

_FIRST, _ROWS, _COLUMNS = range(3)
"""Columns of a pyramid's table of levels: place of the first number, rows, columns."""

_U, _V, _Z = range(0, 3 * VOXELS_PER_BLOCK, VOXELS_PER_BLOCK)
"""Where the planes of the voxels' offsets begin."""


class DepthPyramid(NamedTuple):
    """Largest depth of tiles of 8, 16, 32 ... pixels, level after level in one array."""

    largest: np.ndarray
    levels: np.ndarray
    """[L, 3]: see ``_FIRST``."""


class View(NamedTuple):
    """Pose [4, 4] and intrinsic matrix [3, 3] of the camera, float64; one is added to the principal point."""

    T_CW: np.ndarray
    K: np.ndarray


class Limits(NamedTuple):
    """Metres, float64; the largest weight is a count."""

    far: float
    truncation: float
    voxel_size: float
    max_weight: float


class Method(NamedTuple):
    """Whether distances are along the ray, and how they are averaged, a number of ``_AVERAGES``."""

    along_ray: bool
    average: int


class Voxels(NamedTuple):
    """The blocks [B, 3] and the values of their voxels, block after block."""

    coords: np.ndarray
    D: np.ndarray
    W: np.ndarray
    rgb: np.ndarray


class Image(NamedTuple):
    """Depth and 8-bit colour of every pixel in one word, and colours that are float32: empty if they are bytes."""

    packed: np.ndarray
    rgb: np.ndarray


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
    in_bytes, rgb = (colour.reshape(-1), _NO_FLOATS) if frame.is_8_bit else (_NO_BYTES, colour.reshape(-1))
    limits = Limits(
        far=float(config.far_m),
        truncation=float(config.truncation_m),
        voxel_size=float(config.voxel_size_m),
        max_weight=float(config.max_weight),
    )
    method = Method(along_ray=config.sdf == "ray", average=_AVERAGES[config.average])
    D, W, colours = (t.view(-1).numpy() for t in (volume.D, volume.W, volume.rgb_planes))
    voxels = Voxels(coords=volume.block_coords.numpy(), D=D, W=W, rgb=colours)
    with launching():
        packed, pyramid = _packed(depth, in_bytes, config.near_m)
        seen = np.zeros(volume.n_blocks, np.uint8)
        _observable(voxels.coords, K @ T_CW[:3], T_CW[2], limits, depth.shape, pyramid, seen)
        rows = np.flatnonzero(seen).astype(np.int32)
        updated = np.zeros(-(-len(rows) // _CHUNK), np.int64)
        image, view = Image(packed=packed, rgb=rgb), View(T_CW=T_CW, K=K)
        _fuse(rows, voxels, image, depth.shape, view, limits, method, updated)
    return int(updated.sum())


def _packed(depth: np.ndarray, colour: np.ndarray, near_m: float) -> tuple[np.ndarray, DepthPyramid]:
    """Depth bits and, if ``colour`` [H W 3] has any bytes, colour of every pixel in one word; a pyramid of depths.

    Unknown depth becomes ``_MISSING``.
    """
    height, width = depth.shape
    levels = [(0, -(-height // _TILE), -(-width // _TILE))]
    while levels[-1][_ROWS] > 1 or levels[-1][_COLUMNS] > 1:
        first, h, w = levels[-1]
        levels.append((first + h * w, (h + 1) // 2, (w + 1) // 2))
    packed = np.empty(height * width, np.uint64)
    pyramid = DepthPyramid(largest=np.empty(levels[-1][_FIRST] + 1, np.float32), levels=np.array(levels))
    _pack(depth, colour, f32(near_m), pyramid, packed)
    return packed, pyramid


@njit(parallel=True, cache=True, error_model="numpy")
def _pack(depth, colour, near, pyramid, packed):
    """See ``_packed``."""
    largest, levels = pyramid.largest, pyramid.levels
    height, width = depth.shape
    h, w = levels[0, _ROWS], levels[0, _COLUMNS]
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
            largest[i * w + j] = most
    for k in range(1, levels.shape[0]):
        below, fine_h, fine_w = levels[k - 1, _FIRST], levels[k - 1, _ROWS], levels[k - 1, _COLUMNS]
        for i in range(levels[k, _ROWS]):
            for j in range(levels[k, _COLUMNS]):
                most = _MISSING
                for y in range(2 * i, min(2 * i + 2, fine_h)):
                    for x in range(2 * j, min(2 * j + 2, fine_w)):
                        most = max(most, largest[below + y * fine_w + x])
                largest[levels[k, _FIRST] + i * levels[k, _COLUMNS] + j] = most


@njit(parallel=True, cache=True, error_model="numpy")
def _observable(coords, M, axis_z, limits, size, pyramid, seen):
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
            seen[i] = Z - half_z < _farthest(largest, levels, box, width, height) + truncation + 1e-5 * Z


@njit(cache=True, error_model="numpy")
def _farthest(largest, levels, box, width, height):
    """Largest known depth in a box of pixels."""
    low_u, high_u, low_v, high_v = box
    u0, u1 = int(max(low_u, 0.0)), int(min(high_u, width - 1.0))
    v0, v1 = int(max(low_v, 0.0)), int(min(high_v, height - 1.0))
    level, tile = 0, _TILE
    while level < levels.shape[0] - 1 and max(u1 // tile - u0 // tile, v1 // tile - v0 // tile) >= _SCAN:
        level, tile = level + 1, tile * 2
    first, columns = levels[level, _FIRST], levels[level, _COLUMNS]
    most = _MISSING
    for i in range(v0 // tile, v1 // tile + 1):
        for j in range(u0 // tile, u1 // tile + 1):
            most = max(most, largest[first + i * columns + j])
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
        out[_U + n] = K[0, 0] * X + K[0, 2] * Z
        out[_V + n] = K[1, 1] * Y + K[1, 2] * Z
        out[_Z + n] = Z
    return out


@njit(cache=True, error_model="numpy")
def _as_published(D, d, W, W_k, average):
    """Averages "eq9" and "int16" of ``tsdf_update``."""
    if average == _EQ9:
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
def _fuse(rows, voxels, image, size, view, limits, method, updated):
    """Update the voxels of the blocks ``rows``; ``updated`` [tasks] takes the numbers of voxels observed.

    A task takes every n-th block, so that tasks cost about the same wherever the hidden blocks are.
    """
    coords, D, W, C = voxels.coords, voxels.D, voxels.W, voxels.rgb
    T_CW, K = view.T_CW, view.K
    packed, rgb = image.packed, image.rgb
    along_ray, average = method.along_ray, method.average
    offset = _offsets(T_CW, K, limits.voxel_size)
    height, width = size
    n_tasks = updated.shape[0]
    side, truncation, max_weight = BLOCK_VOXELS * limits.voxel_size, limits.truncation, limits.max_weight
    for task in prange(n_tasks):
        zero, one, eps, missing = splat(_ZERO), splat(_ONE), splat(_EPS), splat(_MISSING)
        end_u, end_v = splat(f32(width + 1)), splat(f32(height + 1))
        stride, first_pixel, three = splat_int(np.int32(width)), splat_int(np.int32(width + 1)), splat_int(np.int32(3))
        grey_level = splat(_ONE / _GREY_LEVELS)
        behind, inv_truncation = splat(f32(-truncation)), splat(f32(1.0 / truncation))
        most = splat(f32(max_weight))
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
                away = corner_z + load(offset, _Z + o)
                inv_z = one / away
                u = times(corner_u + load(offset, _U + o), inv_z)
                v = times(corner_v + load(offset, _V + o), inv_z)
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
                if average == _MEAN:
                    store(D, at, D_old + select(observed, step * (d - D_old), zero))
                else:
                    store(D, at, select(observed, _as_published(D_old, d, W_old, W_new, average), D_old))
                for c in range(3):
                    prefetch(C, 3 * ahead + c * VOXELS_PER_BLOCK + o)
                red_at = row * 3 * VOXELS_PER_BLOCK + o
                green_at, blue_at = red_at + VOXELS_PER_BLOCK, red_at + 2 * VOXELS_PER_BLOCK
                if rgb.shape[0] > 0:
                    red, green, blue = (
                        pixel * three,
                        pixel * three + splat_int(int32(1)),
                        pixel * three + splat_int(int32(2)),
                    )
                    store(C, red_at, load(C, red_at) + step * (gather(rgb, red, observed, zero) - load(C, red_at)))
                    store(
                        C, green_at, load(C, green_at) + step * (gather(rgb, green, observed, zero) - load(C, green_at))
                    )
                    store(C, blue_at, load(C, blue_at) + step * (gather(rgb, blue, observed, zero) - load(C, blue_at)))
                else:
                    store(C, red_at, load(C, red_at) + step * (first_byte(colour) * grey_level - load(C, red_at)))
                    store(
                        C, green_at, load(C, green_at) + step * (second_byte(colour) * grey_level - load(C, green_at))
                    )
                    store(C, blue_at, load(C, blue_at) + step * (third_byte(colour) * grey_level - load(C, blue_at)))
        updated[task] = count
