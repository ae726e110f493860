"""Fold a frame into the volume: one pass over the blocks to find what it can observe, one over their voxels.

A block is 32 vectors of two rows of eight voxels. Its homogeneous pixel coordinates are one corner plus 512 offsets
that all blocks share, as in the reference, whose roundings are repeated here: distance "z" gives the same bits.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

import numpy as np
import torch
from numba import int32, njit, prange

from gsfusion_nb.geometry import se3
from gsfusion_nb.tsdf.block_pool import BLOCK_VOXELS, VOXELS_PER_BLOCK
from gsfusion_nb.tsdf.integrate import INT16_ONE, LEAST_COLOUR_WEIGHT, LITTLE_COLOUR, NEAREST_COLOUR_M
from gsfusion_nb.tsdf.integrate import fuse_frame_ as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Frame

from ..runtime.numba.launch import launching
from ..runtime.numba.simd import (
    absolute,
    any_lane,
    count_lanes,
    first_byte,
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
    third_byte,
    times,
    truncate,
)
from .depth_pyramid import MISSING, find_observable, packed_image
from .layout import Image, Limits, Method, View, Voxels

f32 = np.float32
_EPS = f32(1e-4)
_ZERO, _ONE = f32(0.0), f32(1.0)
_GREY_LEVELS = f32(255.0)
_LEAST, _LITTLE, _MOST_BY_DISTANCE = f32(LEAST_COLOUR_WEIGHT), f32(LITTLE_COLOUR), f32(NEAREST_COLOUR_M**-2)
_MEAN, _EQ9, _INT16 = range(3)
_AVERAGES = {"mean": _MEAN, "eq9": _EQ9, "int16": _INT16}
_INT16_ONE, _INT16_ULP = f32(INT16_ONE), f32(1.0 / INT16_ONE)
_ULP_IS_ONE = f32(2.0**23)
"""From here on float32 numbers are whole: adding and subtracting it rounds a smaller positive number."""

_CHUNK = 16
"""Blocks of one parallel task."""

_NO_FLOATS, _NO_BYTES = np.empty(0, np.float32), np.empty(0, np.uint8)

_U, _V, _Z = range(0, 3 * VOXELS_PER_BLOCK, VOXELS_PER_BLOCK)
"""Where the planes of the voxels' offsets begin."""


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
        colour_band=float(config.colour_band_voxels * config.voxel_size_m),
    )
    method = Method(
        along_ray=config.sdf == "ray",
        average=_AVERAGES[config.average],
        weighs_colours=config.weighs_colours,
        colour_by_distance=config.colour_by_distance,
    )
    D, W, colours, W_rgb = (t.view(-1).numpy() for t in (volume.D, volume.W, volume.rgb_planes, volume.W_rgb))
    voxels = Voxels(coords=volume.block_coords.numpy(), D=D, W=W, rgb=colours, W_rgb=W_rgb)
    with launching():
        packed, pyramid = packed_image(depth, in_bytes, config.near_m)
        seen = np.zeros(volume.n_blocks, np.uint8)
        find_observable(voxels.coords, K @ T_CW[:3], T_CW[2], limits, depth.shape, pyramid, seen)
        rows = np.flatnonzero(seen).astype(np.int32)
        updated = np.zeros(-(-len(rows) // _CHUNK), np.int64)
        image, view = Image(packed=packed, rgb=rgb), View(T_CW=T_CW, K=K)
        _fuse(rows, voxels, image, depth.shape, view, limits, method, updated)
    return int(updated.sum())


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


@njit(inline="always")
def _average_bytes(C, at, step, colour):
    """Move the colours of sixteen voxels by ``step`` towards 8-bit ones; ``at``: where those of the block begin."""
    grey_level = splat(_ONE / _GREY_LEVELS)
    green_at, blue_at = at + VOXELS_PER_BLOCK, at + 2 * VOXELS_PER_BLOCK
    store(C, at, load(C, at) + step * (first_byte(colour) * grey_level - load(C, at)))
    store(C, green_at, load(C, green_at) + step * (second_byte(colour) * grey_level - load(C, green_at)))
    store(C, blue_at, load(C, blue_at) + step * (third_byte(colour) * grey_level - load(C, blue_at)))


@njit(inline="always")
def _average_floats(C, at, step, rgb, pixel, observed):
    """The same towards the colours of pixels in a float32 image."""
    zero = splat(_ZERO)
    green_at, blue_at = at + VOXELS_PER_BLOCK, at + 2 * VOXELS_PER_BLOCK
    red = pixel * splat_int(int32(3))
    green, blue = red + splat_int(int32(1)), red + splat_int(int32(2))
    store(C, at, load(C, at) + step * (gather(rgb, red, observed, zero) - load(C, at)))
    store(C, green_at, load(C, green_at) + step * (gather(rgb, green, observed, zero) - load(C, green_at)))
    store(C, blue_at, load(C, blue_at) + step * (gather(rgb, blue, observed, zero) - load(C, blue_at)))


@njit(inline="always")
def _colour_weight(sdf, inv_z, W_rgb, inv_band, by_distance):
    """See ``gsfusion_nb.tsdf.integrate.colour_weight``; ``inv_band``: 0 for no band."""
    w = splat(_ONE)
    if by_distance:
        w = minimum(inv_z * inv_z, splat(_MOST_BY_DISTANCE))
    w = w * maximum(splat(_ONE) - absolute(sdf) * inv_band, splat(_ZERO))
    return select(splat(_LITTLE) > W_rgb, maximum(w, splat(_LEAST)), w)


@njit(inline="always")
def _corner(coords, row, side, T_CW, K):
    """A block's corner in the camera frame, times K: (u z, v z, z), each in all lanes."""
    x, y, z = coords[row, 0] * side, coords[row, 1] * side, coords[row, 2] * side
    X = T_CW[0, 0] * x + T_CW[0, 1] * y + T_CW[0, 2] * z + T_CW[0, 3]
    Y = T_CW[1, 0] * x + T_CW[1, 1] * y + T_CW[1, 2] * z + T_CW[1, 3]
    Z = T_CW[2, 0] * x + T_CW[2, 1] * y + T_CW[2, 2] * z + T_CW[2, 3]
    return splat(f32(K[0, 0] * X + K[0, 2] * Z)), splat(f32(K[1, 1] * Y + K[1, 2] * Z)), splat(f32(Z))


@njit(inline="always")
def _ray_per_depth(slope_u, slope_v):
    """Length of the viewing ray for each metre of depth."""
    return sqrt(splat(_ONE) + slope_u * slope_u + slope_v * slope_v)


@njit(inline="always")
def _place(corner, offset, o, end_u, end_v):
    """Where sixteen voxels of a block are seen: which are in the picture, 1 / z, z, and (u, v) plus a pixel."""
    one = splat(_ONE)
    away = corner[2] + load(offset, _Z + o)
    inv_z = one / away
    u, v = times(corner[0] + load(offset, _U + o), inv_z), times(corner[1] + load(offset, _V + o), inv_z)
    inside = (u >= one) & (u < end_u) & (v >= one) & (v < end_v) & (away >= splat(_EPS))
    return inside, inv_z, away, u, v


@njit(inline="always")
def _update(D, W, at, sdf, observed, inv_truncation, most, average):
    """The running average of sixteen voxels, Eq. 7 to 9. Returns the share of the new value."""
    zero, one = splat(_ZERO), splat(_ONE)
    W_old, D_old = load(W, at), load(D, at)
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
    return select(w > splat(_ZERO), minimum(w / maximum(W_new, splat(_LEAST)), splat(_ONE)), splat(_ZERO))


@njit(parallel=True, cache=True, error_model="numpy")
def _fuse(rows, voxels, image, size, view, limits, method, updated):
    """Update the voxels of the blocks ``rows``; ``updated`` [tasks] takes the numbers of voxels observed.

    A task takes every n-th block, so that tasks cost about the same wherever the hidden blocks are.
    """
    coords, D, W, C, W_rgb = voxels.coords, voxels.D, voxels.W, voxels.rgb, voxels.W_rgb
    T_CW, K = view.T_CW, view.K
    packed, rgb = image.packed, image.rgb
    along_ray, average = method.along_ray, method.average
    weighs_colours, by_distance = method.weighs_colours, method.colour_by_distance
    inv_band_width = f32(1.0 / limits.colour_band) if limits.colour_band > 0.0 else _ZERO
    offset = _offsets(T_CW, K, limits.voxel_size)
    height, width = size
    n_tasks = updated.shape[0]
    side, truncation, max_weight = BLOCK_VOXELS * limits.voxel_size, limits.truncation, limits.max_weight
    for task in prange(n_tasks):
        zero, one, missing = splat(_ZERO), splat(_ONE), splat(MISSING)
        end_u, end_v = splat(f32(width + 1)), splat(f32(height + 1))
        stride, first_pixel = splat_int(np.int32(width)), splat_int(np.int32(width + 1))
        behind, inv_truncation = splat(f32(-truncation)), splat(f32(1.0 / truncation))
        most, inv_band = splat(f32(max_weight)), splat(inv_band_width)
        fx, fy, cx, cy = splat(f32(1.0 / K[0, 0])), splat(f32(1.0 / K[1, 1])), splat(f32(K[0, 2])), splat(f32(K[1, 2]))
        count = 0
        for r in range(task, len(rows), n_tasks):
            row = rows[r]
            ahead = rows[min(r + n_tasks, len(rows) - 1)] * VOXELS_PER_BLOCK
            corner = _corner(coords, row, side, T_CW, K)
            for o in range(0, VOXELS_PER_BLOCK, 16):
                prefetch(W, ahead + o)
                prefetch(D, ahead + o)
                inside, inv_z, away, u, v = _place(corner, offset, o, end_u, end_v)
                if not any_lane(inside):
                    continue
                pixel = truncate(select(inside, v, one)) * stride + truncate(select(inside, u, one)) - first_pixel
                measured, colour = gather_pairs(packed, pixel, inside, missing)
                sdf = measured - away  # GSFusion Eq. 6
                if along_ray:
                    sdf = sdf * _ray_per_depth(times(u - cx, fx), times(v - cy, fy))
                observed = sdf > behind
                if not any_lane(observed):
                    continue
                count += count_lanes(observed)
                at = row * VOXELS_PER_BLOCK + o
                step = _update(D, W, at, sdf, observed, inv_truncation, most, average)
                if weighs_colours:
                    w = select(observed, _colour_weight(sdf, inv_z, load(W_rgb, at), inv_band, by_distance), zero)
                    if not any_lane(w > zero):
                        continue
                    step = _update_colour_weight(W_rgb, at, w, most)
                for c in range(3):
                    prefetch(C, 3 * ahead + c * VOXELS_PER_BLOCK + o)
                colour_at = row * 3 * VOXELS_PER_BLOCK + o
                if rgb.shape[0] > 0:
                    _average_floats(C, colour_at, step, rgb, pixel, observed)
                else:
                    _average_bytes(C, colour_at, step, colour)
        updated[task] = count
