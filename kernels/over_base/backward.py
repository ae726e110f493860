"""Sums of the loss gradient over the pixels of each splat, one splat after another, sixteen pixels a vector (numba).

What a pixel gives to every splat over it are four numbers, q and -q . C, so a splat is finished in one go, whatever its
place among the others.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false

import numpy as np
from numba import njit, prange

from ..composite.front_to_back import CEILING, HALF, ONE, ZERO, across, row_exponent
from ..composite.layout import SUM_BLUE, SUM_DEPTH, SUM_G, SUM_GREEN, SUM_GX, SUM_GXX, SUM_GXY, SUM_GY, SUM_GYY, SUM_RED
from ..project.layout import BLUE, CONIC_A, CONIC_B, CONIC_C, DEPTH, GREEN, RED, V
from ..runtime.numba.scalars import cyclic_size, cyclic_task
from ..runtime.numba.simd import LANES, any_lane, exp, load, minimum, negative_abs, reduce_add, select, splat
from .forward import column_range, row_range, stride_of

f32 = np.float32
_INFINITE = f32(np.inf)

Q_RED, Q_GREEN, Q_BLUE, MINUS_QC, LIMIT = range(5)
"""Planes: dL/d of the sum of w c, minus its product with the picture, and where splats are hidden."""
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
            total, D = base.weight[y, x] + image.weight[y, x], base.depth[y, x]
            per = ONE / total if total > ZERO else ZERO
            red, green, blue = v_rgb[y, x, 0] * per, v_rgb[y, x, 1] * per, v_rgb[y, x, 2] * per
            planes[Q_RED, y, x], planes[Q_GREEN, y, x], planes[Q_BLUE, y, x] = red, green, blue
            qC = red * image.rgb[y, x, 0] + green * image.rgb[y, x, 1] + blue * image.rgb[y, x, 2]
            planes[MINUS_QC, y, x] = -qC
            planes[LIMIT, y, x] = D + behind if D > ZERO else _INFINITE


@njit(parallel=True, cache=True, error_model="numpy")
def splat_sums(splats, drawn, trained, planes, size, sums, abs_sums):
    """Write the sums of each drawn splat to its row of ``sums`` [M, PAIR_SUMS].

    drawn: the rows of the map that are drawn. trained: bool [N], or [0] for all; the sums of others are not written.
    planes: one after another, flat. abs_sums: [M, 2], for the sums of |dL/du| and |dL/dv|, or None.
    """
    height, width = size
    all_trained = trained.shape[0] == 0
    M = drawn.shape[0]
    n_parts = (M + _CHUNK - 1) // _CHUNK
    for k_part in prange(cyclic_size(n_parts)):
        part = cyclic_task(k_part, n_parts)
        if part >= n_parts:
            continue
        for m in range(part * _CHUNK, min(M, part * _CHUNK + _CHUNK)):
            if all_trained or trained[drawn[m]]:
                sums[m] = ZERO
                if abs_sums is not None:
                    abs_sums[m] = ZERO
                _add_up(splats[drawn[m]], planes, height, width, sums[m], abs_sums, m)


@njit(inline="always")
def _add_up(s, planes, height, width, out, abs_sums, m):
    """Add the sums over the pixels of a splat to ``out`` and to row ``m`` of ``abs_sums``."""
    first, end = row_range(s, 0, height)
    left, right = column_range(s, width)
    stride = stride_of(width)
    plane = height * stride
    red, green, blue, z = splat(s[RED]), splat(s[GREEN]), splat(s[BLUE]), splat(s[DEPTH])
    zero = splat(ZERO)
    for x in range(left, right, LANES):
        dx, q0, q1 = across(s, x)
        sum_g, sum_gy, sum_gyy, sum_r, sum_gr, sum_b = zero, zero, zero, zero, zero, zero
        minus_u, minus_v = zero, zero
        for y in range(first, end):
            dy = f32(y) + HALF - s[V]
            log_alpha, seen = row_exponent(s, q0, q1, dy)
            o = y * stride + x
            seen = seen & (load(planes, LIMIT * plane + o) >= z)
            if not any_lane(seen):
                continue
            raw = exp(log_alpha)
            w = select(seen, minimum(raw, splat(CEILING)), zero)
            q_r, q_g = load(planes, o), load(planes, Q_GREEN * plane + o)
            q_b = load(planes, Q_BLUE * plane + o)
            v_w = red * q_r + green * q_g + blue * q_b + load(planes, MINUS_QC * plane + o)
            g = select(seen & (raw < splat(CEILING)), v_w * w, zero)
            gy = g * splat(dy)
            sum_g, sum_gy, sum_gyy = sum_g + g, sum_gy + gy, sum_gyy + gy * splat(dy)
            sum_r, sum_gr, sum_b = sum_r + w * q_r, sum_gr + w * q_g, sum_b + w * q_b
            if abs_sums is not None:
                minus_u = minus_u + negative_abs(g * (splat(s[CONIC_A]) * dx + splat(s[CONIC_B] * dy)))
                minus_v = minus_v + negative_abs(g * (splat(s[CONIC_B]) * dx + splat(s[CONIC_C] * dy)))
        gx = sum_g * dx
        out[SUM_GX] += reduce_add(gx)
        out[SUM_GY] += reduce_add(sum_gy)
        out[SUM_GXX] += reduce_add(gx * dx)
        out[SUM_GXY] += reduce_add(sum_gy * dx)
        out[SUM_GYY] += reduce_add(sum_gyy)
        out[SUM_G] += reduce_add(sum_g)
        out[SUM_RED] += reduce_add(sum_r)
        out[SUM_GREEN] += reduce_add(sum_gr)
        out[SUM_BLUE] += reduce_add(sum_b)
        if abs_sums is not None:
            abs_sums[m, 0] -= reduce_add(minus_u)
            abs_sums[m, 1] -= reduce_add(minus_v)
    out[SUM_DEPTH] = ZERO
