"""Sums of the brightness error in one pass over the pixels of a frame.

The formulas are those of ``gsfusion_nb.tracking.brightness``. As in the kernel of ICP, each row of
pixels first lists sqrt(w) [J, r, 1] in columns, then multiplies them; rows are added up in order.
"""

# Arrays are passed on as tuples, which pyright cannot follow:
# pyright: reportCallIssue=false

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.tracking.brightness import FLAT, USUAL_ERROR, BrightnessSystem, Picture
from gsfusion_nb.tracking.brightness import brightness_system as reference
from gsfusion_nb.tracking.surface import DepthLevel

from ..icp.numba import dot, poses_of
from ..runtime.arguments import lens_of
from ..runtime.numba.launch import launching

f32 = np.float32
_N_COLUMNS = 8
_N_SUMS = 36
_BEFORE = [sum(range(8, 8 - i, -1)) - i for i in range(8)]
_ENTRIES = torch.tensor([[_BEFORE[min(i, j)] + max(i, j) for j in range(8)] for i in range(8)])
"""Where among the sums each entry of the Gram matrix is; they are its rows from the diagonal on."""
_ZERO = f32(0.0)
_HALF = f32(0.5)
_ONE = f32(1.0)
_FLAT_SQUARE = f32(FLAT) * f32(FLAT)
_PER_ERROR = f32(1.0 / USUAL_ERROR)


def brightness_system(
    level: DepthLevel,
    brightness: Tensor,
    T_WC: Tensor,
    picture: Picture,
    *,
    max_distance_m: float,
    offset: float = 0.0,
) -> BrightnessSystem:
    """See ``gsfusion_nb.tracking.brightness_system``."""
    images = (level.depth_m, brightness, picture.depth_m, picture.brightness, picture.gradient)
    if any(t.dtype != torch.float32 or t.device.type != "cpu" for t in images):
        options = {"max_distance_m": max_distance_m, "offset": offset}
        return reference.reference(level, brightness, T_WC, picture, **options)
    arrays = tuple(t.detach().contiguous().numpy() for t in images)
    poses = poses_of(T_WC, picture.T_WC)
    with launching():
        sums, n = _sum_rows(
            arrays,
            poses,
            lens_of(level.camera, f32),
            lens_of(picture.camera, f32),
            f32(max_distance_m),
            f32(offset),
        )
    return BrightnessSystem(gram=torch.from_numpy(sums.sum(0))[_ENTRIES], n=int(n.sum()))


@njit(cache=True, error_model="numpy")
def _compare(arrays, poses, lens, picture_lens, max_distance_m, offset, j, columns):
    """Write sqrt(w) [J, r, 1] of the pixels of row j that both see to ``columns``; their number.

    arrays: depth and brightness of the frame [H, W]; depth, brightness [h, w] and gradient
    [h, w, 2] of the picture.
    """
    depth, brightness, picture_depth, picture, gradient = arrays
    T = poses.T_WC
    R = poses.R_WS
    height, width = picture.shape
    fx = picture_lens.fx
    fy = picture_lens.fy
    cx = picture_lens.cx
    cy = picture_lens.cy
    y = (f32(j) + _HALF - lens.cy) / lens.fy
    k = 0
    for i in range(depth.shape[1]):
        z = depth[j, i]
        if not z > _ZERO:
            continue
        X = z * ((f32(i) + _HALF - lens.cx) / lens.fx)
        Y = z * y
        p0 = T[0, 0] * X + T[0, 1] * Y + T[0, 2] * z + T[0, 3]
        p1 = T[1, 0] * X + T[1, 1] * Y + T[1, 2] * z + T[1, 3]
        p2 = T[2, 0] * X + T[2, 1] * Y + T[2, 2] * z + T[2, 3]
        s2 = R[0, 2] * p0 + R[1, 2] * p1 + R[2, 2] * p2
        if not s2 > _ZERO:
            continue
        s0 = R[0, 0] * p0 + R[1, 0] * p1 + R[2, 0] * p2
        s1 = R[0, 1] * p0 + R[1, 1] * p1 + R[2, 1] * p2
        u = fx * (s0 / s2) + cx
        v = fy * (s1 / s2) + cy
        if not (u >= _ZERO and u < f32(width) and v >= _ZERO and v < f32(height)):
            continue
        column = int(u)
        row = int(v)
        d = picture_depth[row, column]
        a = gradient[row, column, 0]
        b = gradient[row, column, 1]
        if not (d > _ZERO and abs(s2 - d) <= max_distance_m and a * a + b * b >= _FLAT_SQUARE):
            continue
        r = picture[row, column] + a * (u - f32(column) - _HALF) + b * (v - f32(row) - _HALF)
        r -= brightness[j, i]
        scaled_error = (r - offset) * _PER_ERROR
        w = np.sqrt(_ONE / (_ONE + scaled_error * scaled_error))
        a = w * (a * fx / s2)
        b = w * (b * fy / s2)
        c = -(a * s0 + b * s1) / s2
        g0 = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c
        g1 = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c
        g2 = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c
        columns[0, k] = g0
        columns[1, k] = g1
        columns[2, k] = g2
        columns[3, k] = p1 * g2 - p2 * g1
        columns[4, k] = p2 * g0 - p0 * g2
        columns[5, k] = p0 * g1 - p1 * g0
        columns[6, k] = w * r
        columns[7, k] = w
        k += 1
    return k


@njit(parallel=True, cache=True, error_model="numpy")
def _sum_rows(arrays, poses, lens, picture_lens, max_distance_m, offset):
    """The sums for each row of pixels [H, 36], and the number of pixels [H]."""
    height, width = arrays[0].shape
    sums = np.empty((height, _N_SUMS))
    count = np.empty(height, np.int64)
    for j in prange(height):
        columns = np.empty((_N_COLUMNS, width), np.float32)
        n = _compare(arrays, poses, lens, picture_lens, max_distance_m, offset, j, columns)
        count[j] = n
        at = 0
        for a in range(_N_COLUMNS):
            for b in range(a, _N_COLUMNS):
                sums[j, at] = dot(columns[a], columns[b], n)
                at += 1
    return sums, count
