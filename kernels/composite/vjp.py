"""The gradient of compositing (numba), one 16x16 tile at a time, one pixel row per vector.

It walks front to back like the forward pass: it repeats the forward decisions exactly, and the part of the pixel still
to come is what is left of the total, so nothing per pair has to be kept between the passes.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false

import numpy as np
from numba import njit, prange

from ..project.layout import BLUE, CONIC_A, CONIC_B, CONIC_C, DEPTH, GREEN, RED, V
from ..runtime.numba.scalars import cyclic_size, cyclic_task
from ..runtime.numba.simd import any_lane, exp, load, minimum, negative_abs, reduce_add, select, splat, store
from .front_to_back import (
    CEILING,
    HALF,
    ONE,
    PIXELS,
    ZERO,
    absorb,
    across,
    alpha_of,
    open_pixels,
    row_exponent,
    rows_of,
    zeros,
)
from .layout import (
    PAIR_SUMS,
    SUM_BLUE,
    SUM_DEPTH,
    SUM_G,
    SUM_GREEN,
    SUM_GX,
    SUM_GXX,
    SUM_GXY,
    SUM_GY,
    SUM_GYY,
    SUM_RED,
    TILE,
)

f32 = np.float32

_REST, _V_RED, _V_GREEN, _V_BLUE, _V_DEPTH, _V_ALPHA = range(PIXELS, 7 * PIXELS, PIXELS)
"""Where the planes begin in a tile's state, after T: what is still to come of C . v, and dL/d of the images."""
_BACKWARD_STATE = 7 * PIXELS


@njit(parallel=True, cache=True, error_model="numpy")
def composite_backward(splats, lists, wanted, image, v_image, pair_sums, abs_sums):
    """Per (tile, splat) sums of the loss gradient, written to ``pair_sums[slot[k]]`` [I, PAIR_SUMS].

    wanted: the pixels that were given to the forward, and the rows whose sums are wanted; the sums of the others are
    not written. image: as the forward made it. v_image: dL/d of it. abs_sums: [I, 2], to which the sums of |dL/du| and
    |dL/dv| are written likewise, or None, for which this is compiled without them.
    With p_k = c_k . v_rgb + z_k v_depth + v_alpha:  dL/dalpha_k = T_k p_k - (sum_{j > k} w_j p_j) / (1 - alpha_k).
    The last sum starts as the whole pixel's, C . v_rgb + D v_depth + alpha v_alpha, and loses w_k p_k at each step.
    """
    ids, offset, slot = lists.ids, lists.offset, lists.slot
    pixels, trained = wanted.pixels, wanted.rows
    all_trained = trained.shape[0] == 0
    height, width = image.depth.shape
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    n_tiles = tiles_x * tiles_y
    for k_tile in prange(cyclic_size(n_tiles)):
        tile = cyclic_task(k_tile, n_tiles)
        if tile >= n_tiles:
            continue
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        end = offset[tile + 1]
        while end > offset[tile] and not (all_trained or trained[ids[end - 1]]):
            end -= 1
        if end == offset[tile]:
            continue
        state = zeros(_BACKWARD_STATE)
        rows_open = np.empty(TILE, np.uint8)
        n_open = open_pixels(state, rows_open, pixels, x0, y0, width, height)
        _read_gradients(state, x0, y0, image, v_image, pixels.shape[0] > 0)
        for k in range(offset[tile], end):
            out = pair_sums[slot[k]]
            if n_open == 0:
                for i in range(PAIR_SUMS):
                    out[i] = ZERO
                if abs_sums is not None:
                    abs_sums[slot[k], 0], abs_sums[slot[k], 1] = ZERO, ZERO
                continue
            s = splats[ids[k]]
            if all_trained or trained[ids[k]]:
                n_open -= _add_up(state, rows_open, s, (x0, y0, height), out, abs_sums, slot[k])
            else:
                n_open -= _pass_through(state, rows_open, s, (x0, y0, height))


@njit(cache=True, error_model="numpy")
def _read_gradients(state, x0, y0, image, v_image, masked):
    """dL/d of the tile's pixels, and the whole of C . v, into their planes."""
    height, width = image.depth.shape
    for r in range(min(TILE, height - y0)):
        for i in range(min(TILE, width - x0)):
            o, y, x = r * TILE + i, y0 + r, x0 + i
            total = ZERO
            for c in range(3):
                state[_V_RED + c * PIXELS + o] = v_image.rgb[y, x, c]
                total += image.rgb[y, x, c] * v_image.rgb[y, x, c]
            if v_image.depth.shape[0] > 0:
                state[_V_DEPTH + o] = v_image.depth[y, x]
                total += image.depth[y, x] * v_image.depth[y, x]
            if v_image.alpha.shape[0] > 0:
                state[_V_ALPHA + o] = v_image.alpha[y, x]
                total += image.alpha[y, x] * v_image.alpha[y, x]
            state[_REST + o] = total
    if masked:  # a loss may have no gradient there, not even a number
        for o in range(PIXELS):
            if state[o] < ZERO:
                for plane in range(_REST, _BACKWARD_STATE, PIXELS):
                    state[plane + o] = ZERO


@njit(inline="always")
def _pass_on(state, o, w, red, green, blue, z):
    """p of a splat with the weights ``w`` in the row at ``o``, and what is still to come behind it."""
    p = red * load(state, _V_RED + o) + green * load(state, _V_GREEN + o) + blue * load(state, _V_BLUE + o)
    p = p + z * load(state, _V_DEPTH + o) + load(state, _V_ALPHA + o)
    rest = load(state, _REST + o) - w * p
    store(state, _REST + o, rest)
    return p, rest


@njit(inline="always")
def _add_up(state, rows_open, s, place, out, abs_sums, slot):
    """Write the sums of a trained splat over the tile at ``place`` (x0, y0, height of the image) to ``out`` and to row
    ``slot`` of ``abs_sums``; returns how many rows it finished."""
    x0, y0, height = place
    first_row, end_row = rows_of(s, y0, height)
    dx, q0, q1 = across(s, x0)
    zero, one = splat(ZERO), splat(ONE)
    red, green, blue, z = splat(s[RED]), splat(s[GREEN]), splat(s[BLUE]), splat(s[DEPTH])
    sum_g, sum_gy, sum_gyy = zero, zero, zero
    sum_r, sum_b, sum_gr, sum_z = zero, zero, zero, zero
    minus_u, minus_v = zero, zero
    finished = 0
    for r in range(first_row, end_row):
        if rows_open[r] == 0:
            continue
        dy = f32(y0 + r) + HALF - s[V]
        log_alpha, seen = row_exponent(s, q0, q1, dy)
        if not any_lane(seen):
            continue
        o = r * TILE
        raw = exp(log_alpha)
        alpha = select(seen, minimum(raw, splat(CEILING)), zero)
        w, T_open, T, goes_on = absorb(state, o, alpha)
        p, rest = _pass_on(state, o, w, red, green, blue, z)
        v_of_alpha = T_open * p - rest / (one - alpha)
        g = select(goes_on & (seen & (raw < splat(CEILING))), v_of_alpha * alpha, zero)
        gy = g * splat(dy)
        sum_g = sum_g + g
        sum_gy = sum_gy + gy
        sum_gyy = sum_gyy + gy * splat(dy)
        sum_r = sum_r + w * load(state, _V_RED + o)
        sum_gr = sum_gr + w * load(state, _V_GREEN + o)
        sum_b = sum_b + w * load(state, _V_BLUE + o)
        sum_z = sum_z + w * load(state, _V_DEPTH + o)
        if abs_sums is not None:
            minus_u = minus_u + negative_abs(g * (splat(s[CONIC_A]) * dx + splat(s[CONIC_B] * dy)))
            minus_v = minus_v + negative_abs(g * (splat(s[CONIC_B]) * dx + splat(s[CONIC_C] * dy)))
        if not any_lane(zero < T):
            rows_open[r] = 0
            finished += 1
    gx = sum_g * dx
    out[SUM_GX], out[SUM_GY] = reduce_add(gx), reduce_add(sum_gy)
    out[SUM_GXX], out[SUM_GXY], out[SUM_GYY] = reduce_add(gx * dx), reduce_add(sum_gy * dx), reduce_add(sum_gyy)
    out[SUM_G], out[SUM_DEPTH] = reduce_add(sum_g), reduce_add(sum_z)
    out[SUM_RED], out[SUM_GREEN], out[SUM_BLUE] = reduce_add(sum_r), reduce_add(sum_gr), reduce_add(sum_b)
    if abs_sums is not None:
        abs_sums[slot, 0], abs_sums[slot, 1] = -reduce_add(minus_u), -reduce_add(minus_v)
    return finished


@njit(cache=True, error_model="numpy")
def _pass_through(state, rows_open, s, place):
    """Take what a frozen splat absorbs from T and from what is still to come; returns how many rows it finished."""
    x0, y0, height = place
    first_row, end_row = rows_of(s, y0, height)
    _, q0, q1 = across(s, x0)
    finished = 0
    for r in range(first_row, end_row):
        if rows_open[r] == 0:
            continue
        log_alpha, seen = row_exponent(s, q0, q1, f32(y0 + r) + HALF - s[V])
        if not any_lane(seen):
            continue
        o = r * TILE
        w, _, T, _ = absorb(state, o, alpha_of(log_alpha, seen))
        _pass_on(state, o, w, splat(s[RED]), splat(s[GREEN]), splat(s[BLUE]), splat(s[DEPTH]))
        if not any_lane(splat(ZERO) < T):
            rows_open[r] = 0
            finished += 1
    return finished
