"""Fold a frame into the volume: one pass over the blocks to find what it can observe, one over
their voxels.

A block is 32 vectors of two rows of eight voxels. Its homogeneous pixel coordinates are one corner
plus 512 offsets that all blocks share, as in the reference, whose roundings are repeated here:
distance "z" gives the same bits.

Which blocks a frame can observe: in view, not beyond the largest depth, not hidden behind what is
seen. For that a pyramid of tiles holds the largest depth in any part of the image; it is made while
depth and colour are packed into words.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

from typing import NamedTuple

import numpy as np
import torch
from numba import int32, njit, prange, uint32, uint64

from gsfusion_nb.geometry import se3
from gsfusion_nb.tsdf.block_pool import BLOCK_VOXELS, VOXELS_PER_BLOCK
from gsfusion_nb.tsdf.integrate import fuse_frame_ as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.tsdf.voxel_update import (
    INT16_ONE,
    LEAST_COLOUR_WEIGHT,
    LITTLE_COLOUR,
    NEAREST_COLOUR_M,
)
from gsfusion_nb.types import Frame

from ..runtime.numba.blocks import blocks_in_view
from ..runtime.numba.launch import launching
from ..runtime.numba.simd import (
    absolute,
    any_lane,
    byte_triples,
    count_lanes,
    first_byte,
    float_bits,
    gather,
    gather_pairs,
    load,
    maximum,
    minimum,
    prefetch,
    second_byte,
    select,
    splat,
    splat_int,
    sqrt,
    store,
    store_pairs,
    third_byte,
    times,
    truncate,
)

f32 = np.float32
_EPS = f32(1e-4)
_ZERO = f32(0.0)
_ONE = f32(1.0)
_INFINITE = f32(np.inf)
_GREY_LEVELS = f32(255.0)
_LEAST = f32(LEAST_COLOUR_WEIGHT)
_LITTLE = f32(LITTLE_COLOUR)
_MOST_BY_DISTANCE = f32(NEAREST_COLOUR_M**-2)
_MEAN, _EQ9, _INT16 = range(3)
_AVERAGES = {"mean": _MEAN, "eq9": _EQ9, "int16": _INT16}
_INT16_ONE = f32(INT16_ONE)
_INT16_ULP = f32(1.0 / INT16_ONE)
_ULP_IS_ONE = f32(2.0**23)
"""From here on float32 numbers are whole: adding and subtracting it rounds a smaller positive
number."""

_CHUNK = 16
"""Blocks of one parallel task."""

_NO_FLOATS = np.empty(0, np.float32)
_NO_BYTES = np.empty(0, np.uint8)

_U, _V, _Z = range(0, 3 * VOXELS_PER_BLOCK, VOXELS_PER_BLOCK)
"""Where the planes of the voxels' offsets begin."""


class Limits(NamedTuple):
    """Metres, float64; the largest weight is a count."""

    far: float
    truncation: float
    voxel_size: float
    max_weight: float
    colour_band: float
    """Half width of the band in which colours count, metres; 0: all do."""


class Voxels(NamedTuple):
    """The blocks [B, 3] and the values of their voxels, block after block."""

    coords: np.ndarray
    D: np.ndarray
    W: np.ndarray
    rgb: np.ndarray
    W_rgb: np.ndarray


MISSING = f32(-1e9)
"""Unknown depth."""

_TILE = 8
"""Edge of the finest tiles, pixels."""

_SCAN = 4
"""A box is looked up on the level of the pyramid where it is less than this many tiles wide."""

_FIRST, _ROWS, _COLUMNS = range(3)
"""Columns of a pyramid's table of levels: place of the first number, rows, columns."""


class DepthPyramid(NamedTuple):
    """Largest depth of tiles of 8, 16, 32 ... pixels, level after level in one array."""

    largest: np.ndarray
    levels: np.ndarray
    """[L, 3]: see ``_FIRST``."""


def packed_image(
    depth: np.ndarray, colour: np.ndarray, near_m: float
) -> tuple[np.ndarray, DepthPyramid]:
    """Depth bits and, if ``colour`` [H W 3] has any bytes, colour of every pixel in one word; a
    pyramid of depths.

    Unknown depth becomes ``MISSING``.
    """
    height, width = depth.shape
    levels = [(0, -(-height // _TILE), -(-width // _TILE))]
    while levels[-1][_ROWS] > 1 or levels[-1][_COLUMNS] > 1:
        first, h, w = levels[-1]
        levels.append((first + h * w, (h + 1) // 2, (w + 1) // 2))
    pixels = np.empty(height * width, np.uint64)
    pyramid = DepthPyramid(
        largest=np.empty(levels[-1][_FIRST] + 1, np.float32), levels=np.array(levels)
    )
    _pack(depth, colour, f32(near_m), pyramid, pixels)
    return pixels, pyramid


@njit(parallel=True, cache=True, error_model="numpy")
def _pack(depth, colour, near_m, pyramid, pixels):
    """See ``packed_image``."""
    largest = pyramid.largest
    levels = pyramid.levels
    height, width = depth.shape
    h = levels[0, _ROWS]
    w = levels[0, _COLUMNS]
    flat_depth = depth.reshape(-1)
    has_bytes = len(colour) > 0
    for i in prange(h):
        column = np.full(w * _TILE + 16, MISSING, np.float32)
        missing = splat(MISSING)
        zero = splat(_ZERO)
        nearest = splat(near_m)
        infinite = splat(_INFINITE)
        for y in range(i * _TILE, min(height, i * _TILE + _TILE)):
            for x in range(0, width - 15, 16):
                at = y * width + x
                d = load(flat_depth, at)
                d = select((d > zero) & (d >= nearest) & (d < infinite), d, missing)
                store(column, x, maximum(load(column, x), d))
                store_pairs(
                    pixels,
                    at,
                    d,
                    byte_triples(colour, 3 * at) if has_bytes else splat_int(int32(0)),
                )
            for x in range(width - width % 16, width):
                d = depth[y, x]
                d = d if (d > _ZERO) & (d >= near_m) & (d < _INFINITE) else MISSING
                column[x] = max(column[x], d)
                at = y * width + x
                word = uint32(0)
                if has_bytes:
                    for c in range(3):
                        word |= uint32(colour[3 * at + c]) << uint32(8 * c)
                pixels[at] = uint64(float_bits(d)) | uint64(word) << uint64(32)
        for j in range(w):
            most = MISSING
            for x in range(j * _TILE, j * _TILE + _TILE):
                most = max(most, column[x])
            largest[i * w + j] = most
    for k in range(1, levels.shape[0]):
        first = levels[k - 1, _FIRST]
        fine_h = levels[k - 1, _ROWS]
        fine_w = levels[k - 1, _COLUMNS]
        for i in range(levels[k, _ROWS]):
            for j in range(levels[k, _COLUMNS]):
                most = MISSING
                for y in range(2 * i, min(2 * i + 2, fine_h)):
                    for x in range(2 * j, min(2 * j + 2, fine_w)):
                        most = max(most, largest[first + y * fine_w + x])
                largest[levels[k, _FIRST] + i * levels[k, _COLUMNS] + j] = most


@njit(cache=True, error_model="numpy")
def farthest(largest, levels, box, width, height):
    """Largest known depth in a box of pixels."""
    low_u, high_u, low_v, high_v = box
    u0 = int(max(low_u, 0.0))
    u1 = int(min(high_u, width - 1.0))
    v0 = int(max(low_v, 0.0))
    v1 = int(min(high_v, height - 1.0))
    level = 0
    tile = _TILE
    while (
        level < levels.shape[0] - 1
        and max(u1 // tile - u0 // tile, v1 // tile - v0 // tile) >= _SCAN
    ):
        level = level + 1
        tile = tile * 2
    first = levels[level, _FIRST]
    columns = levels[level, _COLUMNS]
    most = MISSING
    for i in range(v0 // tile, v1 // tile + 1):
        for j in range(u0 // tile, u1 // tile + 1):
            most = max(most, largest[first + i * columns + j])
    return most


@njit(parallel=True, cache=True, error_model="numpy")
def find_observable(coords, rows, M, axis_z, limits, size, pyramid):
    """Those of the ``blocks_in_view`` with a voxel that may be observed: in the picture, not too
    far, not hidden.

    M [3, 4]: homogeneous pixel coordinates (U, V, Z) of a world point. axis_z: third row of T_CW.
    """
    in_view = np.zeros(len(rows), np.bool_)
    height, width = size
    far_m = limits.far
    truncation = limits.truncation
    largest = pyramid.largest
    levels = pyramid.levels
    side = BLOCK_VOXELS * limits.voxel_size
    half_z = 0.5 * side * (abs(axis_z[0]) + abs(axis_z[1]) + abs(axis_z[2]))
    for i in prange(len(rows)):
        b = rows[i]
        x = side * (coords[b, 0] + 0.5)
        y = side * (coords[b, 1] + 0.5)
        z = side * (coords[b, 2] + 0.5)
        Z = M[2, 0] * x + M[2, 1] * y + M[2, 2] * z + M[2, 3]
        if Z + half_z <= 0.0 or Z - half_z >= far_m + truncation:
            continue
        U = M[0, 0] * x + M[0, 1] * y + M[0, 2] * z + M[0, 3]
        V = M[1, 0] * x + M[1, 1] * y + M[1, 2] * z + M[1, 3]
        low_u = 0.0
        low_v = 0.0
        high_u = width + 1.0
        high_v = height + 1.0
        if Z - half_z > 0.01:
            low_u, high_u, low_v, high_v = _box_around(M, (U, V, Z), side)
            if high_u < 1.0 or high_v < 1.0 or low_u > width + 1 or low_v > height + 1:
                continue
        box = (low_u - 1.0, high_u - 1.0, low_v - 1.0, high_v - 1.0)
        in_view[i] = (
            Z - half_z < farthest(largest, levels, box, width, height) + truncation + 1e-5 * Z
        )
    return rows[in_view]


@njit(cache=True, error_model="numpy")
def _box_around(M, centre, side):
    """Smallest and largest u, and v, of the corners of a block in front of the camera."""
    U, V, Z = centre
    low_u = 1e9
    low_v = 1e9
    high_u = -1e9
    high_v = -1e9
    for c in range(8):
        a = 0.5 * side if c & 1 else -0.5 * side
        b = 0.5 * side if c & 2 else -0.5 * side
        d = 0.5 * side if c & 4 else -0.5 * side
        inv_z = 1.0 / (Z + M[2, 0] * a + M[2, 1] * b + M[2, 2] * d)
        u = (U + M[0, 0] * a + M[0, 1] * b + M[0, 2] * d) * inv_z
        v = (V + M[1, 0] * a + M[1, 1] * b + M[1, 2] * d) * inv_z
        low_u = min(low_u, u)
        high_u = max(high_u, u)
        low_v = min(low_v, v)
        high_v = max(high_v, v)
    return low_u, high_u, low_v, high_v


def fuse_frame_(volume: TsdfVolume, frame: Frame) -> int:
    """See ``gsfusion_nb.tsdf.integrate.fuse_frame_``."""
    if (
        any(t.device.type != "cpu" for t in (frame.depth_m, volume.D))
        or volume.D.dtype != torch.float32
    ):
        return reference.reference(volume, frame)
    if not volume.n_blocks:
        return 0
    camera = frame.camera
    config = volume.config
    T_CW = se3.inverse(frame.T_WC.detach().double()).numpy()
    # (U, V, Z) of a world point: one is added to the pixel so that a truncation towards zero finds
    # it.
    K = np.array(
        [[camera.fx, 0.0, camera.cx + 1], [0.0, camera.fy, camera.cy + 1], [0.0, 0.0, 1.0]]
    )
    depth, colour = (t.detach().contiguous().numpy() for t in (frame.depth_m, frame.colour))
    in_bytes, rgb = (
        (colour.reshape(-1), _NO_FLOATS) if frame.is_8_bit else (_NO_BYTES, colour.reshape(-1))
    )
    limits = Limits(
        far=float(config.far_m),
        truncation=float(config.truncation_m),
        voxel_size=float(config.voxel_size_m),
        max_weight=float(config.max_weight),
        colour_band=float(config.colour_band_voxels * config.voxel_size_m),
    )
    falling = config.colour_weights == "falling"
    method = (
        config.sdf == "ray",
        _AVERAGES[config.average],
        config.weighs_colours,
        config.colour_by_distance,
        falling,
    )
    D, W, colours, W_rgb = (
        t.view(-1).numpy() for t in (volume.D, volume.W, volume.rgb_planes, volume.W_rgb)
    )
    voxels = Voxels(coords=volume.block_coords.numpy(), D=D, W=W, rgb=colours, W_rgb=W_rgb)
    with launching():
        pixels, pyramid = packed_image(depth, in_bytes, config.near_m)
        end_m = min(limits.far, float(pyramid.largest[-1])) + limits.truncation
        pixel_m = (end_m + volume.block_size_m) / min(camera.fx, camera.fy)
        rows = blocks_in_view(volume, camera, T_CW, end_m, pixel_m)
        rows = find_observable(
            voxels.coords, rows, K @ T_CW[:3], T_CW[2], limits, depth.shape, pyramid
        )
        n_updated = np.zeros(-(-len(rows) // _CHUNK), np.int64)
        _fuse(rows, voxels, (pixels, rgb), depth.shape, (T_CW, K), limits, method, n_updated)
    return int(n_updated.sum())


@njit(cache=True, error_model="numpy")
def _offsets(T_CW, K, voxel_size):
    """(U, V, Z) of the 512 voxel centres relative to their block's corner, planes of one array."""
    offsets = np.empty(3 * VOXELS_PER_BLOCK, np.float32)
    for n in range(VOXELS_PER_BLOCK):
        x = ((n >> 6) + 0.5) * voxel_size
        y = ((n >> 3 & 7) + 0.5) * voxel_size
        z = ((n & 7) + 0.5) * voxel_size
        X = T_CW[0, 0] * x + T_CW[0, 1] * y + T_CW[0, 2] * z
        Y = T_CW[1, 0] * x + T_CW[1, 1] * y + T_CW[1, 2] * z
        Z = T_CW[2, 0] * x + T_CW[2, 1] * y + T_CW[2, 2] * z
        offsets[_U + n] = K[0, 0] * X + K[0, 2] * Z
        offsets[_V + n] = K[1, 1] * Y + K[1, 2] * Z
        offsets[_Z + n] = Z
    return offsets


@njit(cache=True, error_model="numpy")
def _as_published(D, d, W, W_k, average):
    """Averages "eq9" and "int16" of ``tsdf_update``."""
    if average == _EQ9:
        return (D * W + d * W_k) / (W + W_k)
    unit = splat(_INT16_ONE)
    one = splat(_ONE)
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
    zero = splat(_ZERO)
    one = splat(_ONE)
    whole = _rounded(x)
    whole = select((x > zero) & (whole > x), whole - one, whole)
    return select((x < zero) & (whole < x), whole + one, whole)


@njit(inline="always")
def _average_bytes(C, at, step, colour):
    """Move the colours of sixteen voxels by ``step`` towards 8-bit ones; ``at``: where those of the
    block begin."""
    grey_level = splat(_ONE / _GREY_LEVELS)
    green_at = at + VOXELS_PER_BLOCK
    blue_at = at + 2 * VOXELS_PER_BLOCK
    store(C, at, load(C, at) + step * (first_byte(colour) * grey_level - load(C, at)))
    store(
        C,
        green_at,
        load(C, green_at) + step * (second_byte(colour) * grey_level - load(C, green_at)),
    )
    store(
        C, blue_at, load(C, blue_at) + step * (third_byte(colour) * grey_level - load(C, blue_at))
    )


@njit(inline="always")
def _average_floats(C, at, step, rgb, pixel, observed):
    """The same towards the colours of pixels in a float32 image."""
    zero = splat(_ZERO)
    green_at = at + VOXELS_PER_BLOCK
    blue_at = at + 2 * VOXELS_PER_BLOCK
    red = pixel * splat_int(int32(3))
    green = red + splat_int(int32(1))
    blue = red + splat_int(int32(2))
    store(C, at, load(C, at) + step * (gather(rgb, red, observed, zero) - load(C, at)))
    store(
        C,
        green_at,
        load(C, green_at) + step * (gather(rgb, green, observed, zero) - load(C, green_at)),
    )
    store(
        C, blue_at, load(C, blue_at) + step * (gather(rgb, blue, observed, zero) - load(C, blue_at))
    )


@njit(inline="always")
def _colour_weight(sdf, inv_z, W_rgb, inv_band, by_distance, falling):
    """See ``gsfusion_nb.tsdf.integrate.colour_weight``; ``inv_band``: 0 for no band."""
    w = splat(_ONE)
    if by_distance:
        w = minimum(inv_z * inv_z, splat(_MOST_BY_DISTANCE))
    ramp = splat(_ONE) - absolute(sdf) * inv_band
    share = maximum(ramp, splat(_ZERO))
    if not falling:
        share = select(ramp >= splat(_ZERO), splat(_ONE), splat(_ZERO))
    w = w * share
    return select(splat(_LITTLE) > W_rgb, maximum(w, splat(_LEAST)), w)


@njit(inline="always")
def _corner(coords, row, side, T_CW, K):
    """A block's corner in the camera frame, times K: (u z, v z, z), each in all lanes."""
    x = coords[row, 0] * side
    y = coords[row, 1] * side
    z = coords[row, 2] * side
    X = T_CW[0, 0] * x + T_CW[0, 1] * y + T_CW[0, 2] * z + T_CW[0, 3]
    Y = T_CW[1, 0] * x + T_CW[1, 1] * y + T_CW[1, 2] * z + T_CW[1, 3]
    Z = T_CW[2, 0] * x + T_CW[2, 1] * y + T_CW[2, 2] * z + T_CW[2, 3]
    return (
        splat(f32(K[0, 0] * X + K[0, 2] * Z)),
        splat(f32(K[1, 1] * Y + K[1, 2] * Z)),
        splat(f32(Z)),
    )


@njit(inline="always")
def _ray_per_depth(slope_u, slope_v):
    """Length of the viewing ray for each metre of depth."""
    return sqrt(splat(_ONE) + slope_u * slope_u + slope_v * slope_v)


@njit(inline="always")
def _place(corner, offset, o, end_u, end_v):
    """Where sixteen voxels of a block are seen: which are in the picture, 1 / z, z, and (u, v) plus
    a pixel."""
    one = splat(_ONE)
    depth = corner[2] + load(offset, _Z + o)
    inv_z = one / depth
    u = times(corner[0] + load(offset, _U + o), inv_z)
    v = times(corner[1] + load(offset, _V + o), inv_z)
    in_image = (u >= one) & (u < end_u) & (v >= one) & (v < end_v) & (depth >= splat(_EPS))
    return in_image, inv_z, depth, u, v


@njit(inline="always")
def _update(D, W, at, sdf, observed, inv_truncation, most, average):
    """The running average of sixteen voxels, Eq. 7 to 9. Returns the share of the new value."""
    zero = splat(_ZERO)
    one = splat(_ONE)
    W_old = load(W, at)
    D_old = load(D, at)
    W_new = select(observed, minimum(W_old + one, most), W_old)  # Eq. 8
    step = select(observed, one / W_new, zero)
    d = maximum(minimum(times(sdf, inv_truncation), one), zero - one)  # Eq. 7
    store(W, at, W_new)
    if average == _MEAN:
        store(D, at, D_old + select(observed, step * (d - D_old), zero))
    else:
        store(D, at, select(observed, _as_published(D_old, d, W_old, W_new, average), D_old))
    return step


@njit(inline="always")
def _update_colour_weight(W_rgb, at, w, most):
    """Add the weights ``w`` to those of sixteen colours. Returns the share of the new colours."""
    W_old = load(W_rgb, at)
    W_new = minimum(W_old + w, most)
    store(W_rgb, at, W_new)
    return select(
        w > splat(_ZERO), minimum(w / maximum(W_new, splat(_LEAST)), splat(_ONE)), splat(_ZERO)
    )


@njit(parallel=True, cache=True, error_model="numpy")
def _fuse(rows, voxels, image, size, view, limits, method, n_updated):
    """Update the voxels of the blocks ``rows``; ``n_updated`` [tasks] takes the numbers of voxels
    observed.

    image: depth and 8-bit colour of every pixel in one word, and colours that are float32, empty if
    they are bytes. view: pose [4, 4] and intrinsic matrix [3, 3], float64, with one added to the
    principal point. method: whether distances are along the ray, how they are averaged, whether
    colours have weights of their own, and whether these fall with the distance, and within the
    band.

    A task takes every n-th block, so that tasks cost about the same wherever the hidden blocks are.
    """
    coords = voxels.coords
    D = voxels.D
    W = voxels.W
    C = voxels.rgb
    W_rgb = voxels.W_rgb
    T_CW, K = view
    pixels, rgb = image
    along_ray, average, weighs_colours, by_distance, falling = method
    inv_band_width = f32(1.0 / limits.colour_band) if limits.colour_band > 0.0 else _ZERO
    offset = _offsets(T_CW, K, limits.voxel_size)
    height, width = size
    n_tasks = n_updated.shape[0]
    side = BLOCK_VOXELS * limits.voxel_size
    truncation = limits.truncation
    max_weight = limits.max_weight
    for task in prange(n_tasks):
        zero = splat(_ZERO)
        one = splat(_ONE)
        missing = splat(MISSING)
        end_u = splat(f32(width + 1))
        end_v = splat(f32(height + 1))
        stride = splat_int(np.int32(width))
        first_pixel = splat_int(np.int32(width + 1))
        lower_bound = splat(f32(-truncation))
        inv_truncation = splat(f32(1.0 / truncation))
        most = splat(f32(max_weight))
        inv_band = splat(inv_band_width)
        fx = splat(f32(1.0 / K[0, 0]))
        fy = splat(f32(1.0 / K[1, 1]))
        cx = splat(f32(K[0, 2]))
        cy = splat(f32(K[1, 2]))
        count = 0
        for r in range(task, len(rows), n_tasks):
            row = rows[r]
            next_row = rows[min(r + n_tasks, len(rows) - 1)] * VOXELS_PER_BLOCK
            corner = _corner(coords, row, side, T_CW, K)
            for o in range(0, VOXELS_PER_BLOCK, 16):
                prefetch(W, next_row + o)
                prefetch(D, next_row + o)
                in_image, inv_z, depth, u, v = _place(corner, offset, o, end_u, end_v)
                if not any_lane(in_image):
                    continue
                pixel = (
                    truncate(select(in_image, v, one)) * stride
                    + truncate(select(in_image, u, one))
                    - first_pixel
                )
                measured_m, colour = gather_pairs(pixels, pixel, in_image, missing)
                sdf = measured_m - depth  # GSFusion Eq. 6
                if along_ray:
                    sdf = sdf * _ray_per_depth(times(u - cx, fx), times(v - cy, fy))
                observed = sdf > lower_bound
                if not any_lane(observed):
                    continue
                count += count_lanes(observed)
                at = row * VOXELS_PER_BLOCK + o
                step = _update(D, W, at, sdf, observed, inv_truncation, most, average)
                if weighs_colours:
                    w = _colour_weight(sdf, inv_z, load(W_rgb, at), inv_band, by_distance, falling)
                    w = select(observed, w, zero)
                    if not any_lane(w > zero):
                        continue
                    step = _update_colour_weight(W_rgb, at, w, most)
                for c in range(3):
                    prefetch(C, 3 * next_row + c * VOXELS_PER_BLOCK + o)
                colour_at = row * 3 * VOXELS_PER_BLOCK + o
                if rgb.shape[0] > 0:
                    _average_floats(C, colour_at, step, rgb, pixel, observed)
                else:
                    _average_bytes(C, colour_at, step, colour)
        n_updated[task] = count
