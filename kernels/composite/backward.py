"""The gradient of ``composite_forward``, one tile at a time; equations and names as there."""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false

import numpy as np
from numba import njit, prange

from ..project.layout import BLUE, CONIC_A, CONIC_B, CONIC_C, DEPTH, GREEN, RED, V
from ..runtime.numba.scalars import cyclic_size, cyclic_task
from ..runtime.numba.simd import (
    any_lane,
    exp,
    load,
    load_triples,
    minimum,
    negative_abs,
    reduce_add,
    select,
    splat,
    store,
    times,
)
from . import layout as pair
from .numba import (
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

f32 = np.float32

_REST, _V_RED, _V_GREEN, _V_BLUE, _V_DEPTH, _V_ALPHA = range(PIXELS, 7 * PIXELS, PIXELS)
"""Where the planes begin in a tile's state, after T: what is still to come of C . v, and dL/d of
the images."""
_BACKWARD_STATE = 7 * PIXELS


@njit(parallel=True, cache=True, error_model="numpy")
def composite_backward(splats, lists, selection, image, v_image, pair_sums, abs_sums):
    """Per (tile, splat) sums of the loss gradient, written to ``pair_sums[slot[k]]`` [I,
    PAIR_SUMS].

    selection: the pixels that were given to the forward, [0, 0] for all, and the rows whose sums
    are wanted, bool [N] or [0] for all; the sums of the others are not written. image: as the
    forward made it. v_image: dL/d of it. abs_sums: [I, 2], to which the sums of |dL/du| and |dL/dv|
    are written likewise, or None, for which this is compiled without them.
    With p_k = c_k . v_rgb + z_k v_depth + v_alpha:  dL/dalpha_k = T_k p_k - (sum_{j > k} w_j p_j) /
    (1 - alpha_k). The last sum starts as the whole pixel's, C . v_rgb + D v_depth + alpha v_alpha,
    and loses w_k p_k at each step.
    """
    ids = lists.ids
    offset = lists.offset
    slot = lists.slot
    pixels, train_rows = selection
    all_trained = train_rows.shape[0] == 0
    has_more = v_image.depth.shape[0] > 0 or v_image.alpha.shape[0] > 0
    height, width = image.depth.shape
    tiles_x = (width + pair.TILE - 1) // pair.TILE
    tiles_y = (height + pair.TILE - 1) // pair.TILE
    n_tiles = tiles_x * tiles_y
    for k_tile in prange(cyclic_size(n_tiles)):
        tile = cyclic_task(k_tile, n_tiles)
        if tile >= n_tiles:
            continue
        x0 = (tile % tiles_x) * pair.TILE
        y0 = (tile // tiles_x) * pair.TILE
        end = offset[tile + 1]
        while end > offset[tile] and not (all_trained or train_rows[ids[end - 1]]):
            end -= 1
        if end == offset[tile]:
            continue
        state = zeros(_BACKWARD_STATE)
        rows_open = np.empty(pair.TILE, np.uint8)
        n_open = open_pixels(state, rows_open, pixels, x0, y0, width, height)
        _read_gradients(state, x0, y0, image, v_image, pixels.shape[0] > 0)
        place = (x0, y0, height)
        for k in range(offset[tile], end):
            sums = pair_sums[slot[k]]
            if n_open == 0:
                for i in range(pair.PAIR_SUMS):
                    sums[i] = ZERO
                if abs_sums is not None:
                    abs_sums[slot[k], 0] = ZERO
                    abs_sums[slot[k], 1] = ZERO
                continue
            s = splats[ids[k]]
            if all_trained or train_rows[ids[k]]:
                n_open -= _add_up(state, rows_open, s, place, has_more, sums, abs_sums, slot[k])
            else:
                n_open -= _pass_through(state, rows_open, s, place, has_more)


@njit(cache=True, error_model="numpy")
def _read_gradients(state, x0, y0, image, v_image, has_mask):
    """dL/d of the tile's pixels, and the whole of C . v, into their planes."""
    if x0 + pair.TILE > image.depth.shape[1]:
        _read_pixels(state, x0, y0, image, v_image)
    else:
        _read_rows(state, x0, y0, image, v_image)
    if has_mask:  # a loss may have no gradient there, not even a number
        for o in range(PIXELS):
            if state[o] < ZERO:
                for plane in range(_REST, _BACKWARD_STATE, PIXELS):
                    state[plane + o] = ZERO


@njit(cache=True, error_model="numpy")
def _read_rows(state, x0, y0, image, v_image):
    """``_read_gradients``, a row of the tile at a time."""
    height, width = image.depth.shape
    rgb = image.rgb.reshape(-1)
    v_rgb = v_image.rgb.reshape(-1)
    for r in range(min(pair.TILE, height - y0)):
        o = r * pair.TILE
        at = (y0 + r) * width + x0
        red, green, blue = load_triples(rgb, 3 * at)
        v_red, v_green, v_blue = load_triples(v_rgb, 3 * at)
        store(state, _V_RED + o, v_red)
        store(state, _V_GREEN + o, v_green)
        store(state, _V_BLUE + o, v_blue)
        # each product rounded by itself, as in ``_read_pixels``
        total = splat(ZERO) + times(red, v_red)
        total = total + times(green, v_green) + times(blue, v_blue)
        if v_image.depth.shape[0] > 0:
            v_depth = load(v_image.depth.reshape(-1), at)
            store(state, _V_DEPTH + o, v_depth)
            total = total + times(load(image.depth.reshape(-1), at), v_depth)
        if v_image.alpha.shape[0] > 0:
            v_alpha = load(v_image.alpha.reshape(-1), at)
            store(state, _V_ALPHA + o, v_alpha)
            total = total + times(load(image.alpha.reshape(-1), at), v_alpha)
        store(state, _REST + o, total)


@njit(cache=True, error_model="numpy")
def _read_pixels(state, x0, y0, image, v_image):
    """``_read_gradients`` of a tile that reaches beyond the right border."""
    height, width = image.depth.shape
    for r in range(min(pair.TILE, height - y0)):
        for i in range(min(pair.TILE, width - x0)):
            o = r * pair.TILE + i
            y = y0 + r
            x = x0 + i
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


@njit(inline="always")
def _pass_on(state, o, w, red, green, blue, z, has_more):
    """p of a splat with the weights ``w`` in the row at ``o``, and what is still to come behind
    it. ``has_more``: depth or alpha have a gradient, too."""
    p = (
        red * load(state, _V_RED + o)
        + green * load(state, _V_GREEN + o)
        + blue * load(state, _V_BLUE + o)
    )
    if has_more:
        p = p + z * load(state, _V_DEPTH + o) + load(state, _V_ALPHA + o)
    rest = load(state, _REST + o) - w * p
    store(state, _REST + o, rest)
    return p, rest


@njit(inline="always")
def _add_up(state, rows_open, s, place, has_more, sums, abs_sums, slot):
    """Write the sums of a trained splat over the tile at ``place`` (x0, y0, height of the image) to
    ``sums`` and to row ``slot`` of ``abs_sums``; returns how many rows it finished."""
    x0, y0, height = place
    first_row, end_row = rows_of(s, y0, height)
    dx, q0, q1 = across(s, x0)
    zero = splat(ZERO)
    one = splat(ONE)
    red = splat(s[RED])
    green = splat(s[GREEN])
    blue = splat(s[BLUE])
    z = splat(s[DEPTH])
    sum_g = zero
    sum_gy = zero
    sum_gyy = zero
    sum_r = zero
    sum_b = zero
    sum_gr = zero
    sum_z = zero
    minus_u = zero
    minus_v = zero
    n_finished = 0
    for r in range(first_row, end_row):
        if rows_open[r] == 0:
            continue
        dy = f32(y0 + r) + HALF - s[V]
        log_alpha, visible = row_exponent(s, q0, q1, dy)
        if not any_lane(visible):
            continue
        o = r * pair.TILE
        raw = exp(log_alpha)
        alpha = select(visible, minimum(raw, splat(CEILING)), zero)
        w, T_open, T, goes_on = absorb(state, o, alpha)
        p, rest = _pass_on(state, o, w, red, green, blue, z, has_more)
        v_of_alpha = T_open * p - rest / (one - alpha)
        g = select(goes_on & (visible & (raw < splat(CEILING))), v_of_alpha * alpha, zero)
        gy = g * splat(dy)
        sum_g = sum_g + g
        sum_gy = sum_gy + gy
        sum_gyy = sum_gyy + gy * splat(dy)
        sum_r = sum_r + w * load(state, _V_RED + o)
        sum_gr = sum_gr + w * load(state, _V_GREEN + o)
        sum_b = sum_b + w * load(state, _V_BLUE + o)
        if has_more:
            sum_z = sum_z + w * load(state, _V_DEPTH + o)
        if abs_sums is not None:
            minus_u = minus_u + negative_abs(g * (splat(s[CONIC_A]) * dx + splat(s[CONIC_B] * dy)))
            minus_v = minus_v + negative_abs(g * (splat(s[CONIC_B]) * dx + splat(s[CONIC_C] * dy)))
        if not any_lane(zero < T):
            rows_open[r] = 0
            n_finished += 1
    gx = sum_g * dx
    sums[pair.SUM_GX] = reduce_add(gx)
    sums[pair.SUM_GY] = reduce_add(sum_gy)
    sums[pair.SUM_GXX] = reduce_add(gx * dx)
    sums[pair.SUM_GXY] = reduce_add(sum_gy * dx)
    sums[pair.SUM_GYY] = reduce_add(sum_gyy)
    sums[pair.SUM_G] = reduce_add(sum_g)
    sums[pair.SUM_DEPTH] = reduce_add(sum_z)
    sums[pair.SUM_RED] = reduce_add(sum_r)
    sums[pair.SUM_GREEN] = reduce_add(sum_gr)
    sums[pair.SUM_BLUE] = reduce_add(sum_b)
    if abs_sums is not None:
        abs_sums[slot, 0] = -reduce_add(minus_u)
        abs_sums[slot, 1] = -reduce_add(minus_v)
    return n_finished


@njit(cache=True, error_model="numpy")
def _pass_through(state, rows_open, s, place, has_more):
    """Take what a frozen splat absorbs from T and from what is still to come; returns how many rows
    it finished."""
    x0, y0, height = place
    first_row, end_row = rows_of(s, y0, height)
    _, q0, q1 = across(s, x0)
    red = splat(s[RED])
    green = splat(s[GREEN])
    blue = splat(s[BLUE])
    z = splat(s[DEPTH])
    n_finished = 0
    for r in range(first_row, end_row):
        if rows_open[r] == 0:
            continue
        log_alpha, visible = row_exponent(s, q0, q1, f32(y0 + r) + HALF - s[V])
        if not any_lane(visible):
            continue
        o = r * pair.TILE
        w, _, T, _ = absorb(state, o, alpha_of(log_alpha, visible))
        _pass_on(state, o, w, red, green, blue, z, has_more)
        if not any_lane(splat(ZERO) < T):
            rows_open[r] = 0
            n_finished += 1
    return n_finished
