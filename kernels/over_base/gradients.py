"""The gradient of ``blend_bands``, splat by splat; equations and names as there."""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

import numpy as np
from numba import njit, prange

from ..composite import layout as pair
from ..composite.numba import CEILING, HALF, ONE, ZERO, across, row_exponent
from ..project.layout import BLUE, CONIC_A, CONIC_B, CONIC_C, DEPTH, GREEN, RED, V
from ..runtime.numba.scalars import cyclic_size, cyclic_task
from ..runtime.numba.simd import (
    LANES,
    any_lane,
    exp,
    load,
    minimum,
    negative_abs,
    reduce_add,
    select,
    splat,
)
from .bands import column_range, row_range, stride_of

f32 = np.float32
_INFINITE = f32(np.inf)


Q_RED, Q_GREEN, Q_BLUE, MINUS_QC, LIMIT = range(5)
"""Planes: dL/d of the sum of w c, minus its product with the picture, and where splats are
hidden."""
PLANES = 5

_CHUNK = 64
"""Splats that one thread takes at a time."""


@njit(parallel=True, cache=True, error_model="numpy")
def gradient_planes(image, base, behind, v_rgb, planes):
    """Fill ``planes`` [PLANES, H, stride]; zero beyond the image."""
    height, width = image.weight.shape
    for y in prange(height):
        planes[:, y, width:] = ZERO
        for x in range(width):
            total = base.weight[y, x] + image.weight[y, x]
            D = base.depth[y, x]
            per = ONE / total if total > ZERO else ZERO
            red = v_rgb[y, x, 0] * per
            green = v_rgb[y, x, 1] * per
            blue = v_rgb[y, x, 2] * per
            planes[Q_RED, y, x] = red
            planes[Q_GREEN, y, x] = green
            planes[Q_BLUE, y, x] = blue
            qC = red * image.rgb[y, x, 0] + green * image.rgb[y, x, 1] + blue * image.rgb[y, x, 2]
            planes[MINUS_QC, y, x] = -qC
            planes[LIMIT, y, x] = D + behind if D > ZERO else _INFINITE


@njit(parallel=True, cache=True, error_model="numpy")
def splat_sums(splats, visible_rows, train_rows, planes, size, sums, abs_sums):
    """Write the sums of each drawn splat to its row of ``sums`` [M, PAIR_SUMS].

    visible_rows: the rows of the map that are drawn. train_rows: bool [N], or [0] for all; the sums
    of others are not written. planes: one after another, flat. abs_sums: [M, 2], for the sums of
    |dL/du| and |dL/dv|, or None.
    """
    height, width = size
    all_trained = train_rows.shape[0] == 0
    M = visible_rows.shape[0]
    n_parts = (M + _CHUNK - 1) // _CHUNK
    for k_part in prange(cyclic_size(n_parts)):
        part = cyclic_task(k_part, n_parts)
        if part >= n_parts:
            continue
        for m in range(part * _CHUNK, min(M, part * _CHUNK + _CHUNK)):
            if all_trained or train_rows[visible_rows[m]]:
                sums[m] = ZERO
                if abs_sums is not None:
                    abs_sums[m] = ZERO
                _add_up(splats[visible_rows[m]], planes, height, width, sums[m], abs_sums, m)


@njit(inline="always")
def _add_up(s, planes, height, width, row_sums, abs_sums, m):
    """Add the sums over the pixels of a splat to ``row_sums`` and to row ``m`` of ``abs_sums``."""
    first, end = row_range(s, 0, height)
    left, right = column_range(s, width)
    stride = stride_of(width)
    plane = height * stride
    red = splat(s[RED])
    green = splat(s[GREEN])
    blue = splat(s[BLUE])
    z = splat(s[DEPTH])
    zero = splat(ZERO)
    for x in range(left, right, LANES):
        dx, q0, q1 = across(s, x)
        sum_g = zero
        sum_gy = zero
        sum_gyy = zero
        sum_r = zero
        sum_gr = zero
        sum_b = zero
        minus_u = zero
        minus_v = zero
        for y in range(first, end):
            dy = f32(y) + HALF - s[V]
            log_alpha, seen = row_exponent(s, q0, q1, dy)
            o = y * stride + x
            seen = seen & (load(planes, LIMIT * plane + o) >= z)
            if not any_lane(seen):
                continue
            raw = exp(log_alpha)
            w = select(seen, minimum(raw, splat(CEILING)), zero)
            q_r = load(planes, o)
            q_g = load(planes, Q_GREEN * plane + o)
            q_b = load(planes, Q_BLUE * plane + o)
            v_w = red * q_r + green * q_g + blue * q_b + load(planes, MINUS_QC * plane + o)
            g = select(seen & (raw < splat(CEILING)), v_w * w, zero)
            gy = g * splat(dy)
            sum_g = sum_g + g
            sum_gy = sum_gy + gy
            sum_gyy = sum_gyy + gy * splat(dy)
            sum_r = sum_r + w * q_r
            sum_gr = sum_gr + w * q_g
            sum_b = sum_b + w * q_b
            if abs_sums is not None:
                minus_u = minus_u + negative_abs(
                    g * (splat(s[CONIC_A]) * dx + splat(s[CONIC_B] * dy))
                )
                minus_v = minus_v + negative_abs(
                    g * (splat(s[CONIC_B]) * dx + splat(s[CONIC_C] * dy))
                )
        gx = sum_g * dx
        row_sums[pair.SUM_GX] += reduce_add(gx)
        row_sums[pair.SUM_GY] += reduce_add(sum_gy)
        row_sums[pair.SUM_GXX] += reduce_add(gx * dx)
        row_sums[pair.SUM_GXY] += reduce_add(sum_gy * dx)
        row_sums[pair.SUM_GYY] += reduce_add(sum_gyy)
        row_sums[pair.SUM_G] += reduce_add(sum_g)
        row_sums[pair.SUM_RED] += reduce_add(sum_r)
        row_sums[pair.SUM_GREEN] += reduce_add(sum_gr)
        row_sums[pair.SUM_BLUE] += reduce_add(sum_b)
        if abs_sums is not None:
            abs_sums[m, 0] -= reduce_add(minus_u)
            abs_sums[m, 1] -= reduce_add(minus_v)
    row_sums[pair.SUM_DEPTH] = ZERO
