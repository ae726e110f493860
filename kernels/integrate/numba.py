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
from numba import njit, prange

from gsfusion_nb.geometry import se3
from gsfusion_nb.tsdf.block_pool import BLOCK_VOXELS, VOXELS_PER_BLOCK
from gsfusion_nb.tsdf.integrate import fuse_frame_ as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Frame

from ..runtime.numba.blocks import blocks_in_view
from ..runtime.numba.launch import launching
from ..runtime.numba.simd import (
    any_lane,
    count_lanes,
    gather_pairs,
    load,
    prefetch,
    select,
    splat,
    splat_int,
    sqrt,
    times,
    truncate,
)
from .averages import (
    AVERAGES,
    average_bytes,
    average_floats,
    colour_weight_of,
    update,
    update_colour_weight,
)
from .observable import MISSING, find_observable, packed_image

f32 = np.float32
_EPS = f32(1e-4)
_ZERO = f32(0.0)
_ONE = f32(1.0)

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
        AVERAGES[config.average],
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
                step = update(D, W, at, sdf, observed, inv_truncation, most, average)
                if weighs_colours:
                    w = colour_weight_of(
                        sdf, inv_z, load(W_rgb, at), inv_band, by_distance, falling
                    )
                    w = select(observed, w, zero)
                    if not any_lane(w > zero):
                        continue
                    step = update_colour_weight(W_rgb, at, w, most)
                for c in range(3):
                    prefetch(C, 3 * next_row + c * VOXELS_PER_BLOCK + o)
                colour_at = row * 3 * VOXELS_PER_BLOCK + o
                if rgb.shape[0] > 0:
                    average_floats(C, colour_at, step, rgb, pixel, observed)
                else:
                    average_bytes(C, colour_at, step, colour)
        n_updated[task] = count
