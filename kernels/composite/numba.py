"""Front-to-back compositing of sorted splats and its gradient, one 16x16 tile at a time, one pixel row per vector.

State per tile is a row-major 16x16 array of the transmittance T; a finished pixel keeps its T with the sign flipped,
and one that is not to be drawn, or lies beyond the image, starts as finished.
The backward pass walks front to back as well: it repeats the forward decisions exactly, and the part of the pixel
still to come is what is left of the total, so nothing per pair has to be kept between the passes.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from gsfusion_nb.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

from ..project.splat import (
    BLUE,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    DEPTH,
    EXTENT_V,
    GREEN,
    LN_OPACITY,
    RED,
    U,
    V,
)
from ..runtime.numba.cyclic import cyclic_size, cyclic_task
from ..runtime.numba.simd import (
    any_lane,
    either,
    exp,
    iota,
    load,
    maximum,
    minimum,
    negative_abs,
    reduce_add,
    select,
    splat,
    store,
)
from .sums import (
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
)

TILE = 16
PIXELS = TILE * TILE

_SUM_RED, _SUM_GREEN, _SUM_BLUE, _SUM_DEPTH, _HEAVIEST, _DOMINANT, _FIRST, _HIT = range(PIXELS, 9 * PIXELS, PIXELS)
"""Where the arrays of the forward pass begin in a tile's state, after T: sums of w c, the largest w, indices."""

_FORWARD_STATE, _FORWARD_STATE_WITHOUT_HITS = 9 * PIXELS, 8 * PIXELS

_REST, _V_RED, _V_GREEN, _V_BLUE, _V_DEPTH, _V_ALPHA = range(PIXELS, 7 * PIXELS, PIXELS)
"""Those of the backward pass: what is still to come of C . v, and dL/d of the images."""
_BACKWARD_STATE = 7 * PIXELS


class PairLists(NamedTuple):
    """The (splat, tile) pairs, sorted by tile, then by depth: tile t has those from ``offset[t]`` to
    ``offset[t + 1]``. int32"""

    ids: np.ndarray
    """Splat of each pair."""
    offset: np.ndarray
    slot: np.ndarray
    """Where the pair's sums go: the slots of a splat are consecutive."""


class Image(NamedTuple):
    """Colour [H, W, 3], depth and alpha [H, W], or dL/d of each; [0, 0] stands for zero. float32"""

    rgb: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray


class IndexImages(NamedTuple):
    """Rows of the first and of the heaviest splat of each pixel, and of the first opaque one; -1 for none.

    int64 [H, W], or [0, 0] if not wanted.
    """

    first: np.ndarray
    dominant: np.ndarray
    hit: np.ndarray


f32 = np.float32
_LOG_ALPHA_MIN = f32(np.log(ALPHA_MIN))
_ALPHA_MAX = f32(ALPHA_MAX)
_T_MIN = f32(TRANSMITTANCE_MIN)
_HALF = f32(0.5)
_ONE = f32(1.0)
_ZERO = f32(0.0)


@njit(cache=True, error_model="numpy")
def _zeros(size):
    """float32 zeros that begin on a cache line: a vector that straddles two costs twice, 5 % of the whole."""
    line = 16
    memory = np.zeros(size + line, np.float32)
    skip = -(memory.ctypes.data // 4) % line
    return memory[skip : skip + size]


@njit(cache=True, error_model="numpy")
def _open_pixels(state, rows_open, pixels, x0, y0, width, height):
    """T in front of the first splat: 1 at the tile's pixels that are to be drawn, else -1. Returns the open rows."""
    tile_width, tile_height = min(TILE, width - x0), min(TILE, height - y0)
    masked = pixels.shape[0] > 0
    if not masked and tile_width == TILE and tile_height == TILE:
        state[:PIXELS] = _ONE
        rows_open[:] = 1
        return TILE
    state[:PIXELS] = -_ONE
    rows_open[:] = 0
    n_open = 0
    for r in range(tile_height):
        for i in range(tile_width):
            if not masked or pixels[y0 + r, x0 + i]:
                state[r * TILE + i] = _ONE
                rows_open[r] = 1
        n_open += rows_open[r]
    return n_open


@njit(cache=True, error_model="numpy")
def _clear(x0, y0, width, height, rgb, depth, alpha, indices):
    """The background on one tile."""
    for y in range(y0, min(y0 + TILE, height)):
        for x in range(x0, min(x0 + TILE, width)):
            rgb[y, x, 0], rgb[y, x, 1], rgb[y, x, 2] = _ZERO, _ZERO, _ZERO
            depth[y, x], alpha[y, x] = _ZERO, _ZERO
    for index in indices:
        if index.shape[0] > 0:
            index[y0 : y0 + TILE, x0 : x0 + TILE] = -1


@njit(parallel=True, cache=True, error_model="numpy")
def composite_forward(splats, lists, pixels, image, indices, opaque):
    """Blend every tile's splats into ``image`` and ``indices``.

    splats [N, SPLAT]: see ``project.splat``. pixels: bool [H, W], those to be drawn, or [0, 0] for all.
    opaque: a hit is the first splat with at least this alpha, even behind the one that finishes the pixel.
    """
    ids, offset = lists.ids, lists.offset
    rgb, depth, alpha_image = image.rgb, image.depth, image.alpha
    first, dominant, hit = indices.first, indices.dominant, indices.hit
    height, width = depth.shape
    with_index, with_hit = first.shape[0] > 0, hit.shape[0] > 0
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    n_tiles = tiles_x * tiles_y
    for k_tile in prange(cyclic_size(n_tiles)):
        tile = cyclic_task(k_tile, n_tiles)
        if tile >= n_tiles:
            continue
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        if offset[tile] == offset[tile + 1]:
            _clear(x0, y0, width, height, rgb, depth, alpha_image, (first, dominant, hit))
            continue
        state = _zeros(_FORWARD_STATE if with_hit else _FORWARD_STATE_WITHOUT_HITS)
        state[_DOMINANT:] = -_ONE
        rows_open = np.empty(TILE, np.uint8)
        n_open = _open_pixels(state, rows_open, pixels, x0, y0, width, height)
        if with_hit:  # finished pixels that still look for a hit keep their row open: -1 there, 0 at those not drawn
            for o in range(PIXELS):
                state[_HIT + o] = -max(state[o], _ZERO)
        centre_x = iota() + splat(f32(x0) + _HALF)
        zero, floor_T = splat(_ZERO), splat(_T_MIN)
        threshold, ceiling, solid = splat(_LOG_ALPHA_MIN), splat(_ALPHA_MAX), splat(opaque)
        for k in range(offset[tile], offset[tile + 1]):
            if n_open == 0:
                break
            s = splats[ids[k]]
            r0 = max(0, int(np.ceil(s[V] - s[EXTENT_V] - _HALF)) - y0)
            r1 = min(min(TILE, height - y0), int(np.floor(s[V] + s[EXTENT_V] - _HALF)) + 1 - y0)
            dx = centre_x - splat(s[U])
            q0 = splat(-_HALF * s[CONIC_A]) * dx * dx + splat(s[LN_OPACITY])
            q1 = splat(-s[CONIC_B]) * dx
            red, green, blue, z = splat(s[RED]), splat(s[GREEN]), splat(s[BLUE]), splat(s[DEPTH])
            for r in range(r0, r1):
                if rows_open[r] == 0:
                    continue
                dy = f32(y0 + r) + _HALF - s[V]
                log_alpha = q1 * splat(dy) + (q0 + splat(-_HALF * s[CONIC_C] * dy * dy))
                seen = log_alpha >= threshold
                if not any_lane(seen):
                    continue
                o = r * TILE
                alpha = select(seen, minimum(exp(log_alpha), ceiling), zero)
                T = load(state, o)
                T_open = maximum(T, zero)
                w = alpha * T_open
                T_next = T_open - w
                goes_on = T_next >= floor_T
                w = select(goes_on, w, zero)
                T = select(goes_on, T_next, negative_abs(T))
                store(state, o, T)
                store(state, _SUM_RED + o, load(state, _SUM_RED + o) + w * red)
                store(state, _SUM_GREEN + o, load(state, _SUM_GREEN + o) + w * green)
                store(state, _SUM_BLUE + o, load(state, _SUM_BLUE + o) + w * blue)
                store(state, _SUM_DEPTH + o, load(state, _SUM_DEPTH + o) + w * z)
                if with_index:  # rows as float32 lanes: exact below 2^24
                    row, heaviest = splat(f32(ids[k])), load(state, _HEAVIEST + o)
                    heavier = w > heaviest
                    store(state, _HEAVIEST + o, select(heavier, w, heaviest))
                    store(state, _DOMINANT + o, select(heavier, row, load(state, _DOMINANT + o)))
                    seen_first = load(state, _FIRST + o)
                    store(state, _FIRST + o, select((w > zero) & (zero > seen_first), row, seen_first))
                open_lanes = zero < T
                if with_hit:
                    hit_before = load(state, _HIT + o)
                    hit_now = select((alpha >= solid) & (zero > hit_before), splat(f32(ids[k])), hit_before)
                    store(state, _HIT + o, hit_now)
                    open_lanes = either(open_lanes, zero > hit_now)
                if not any_lane(open_lanes):
                    rows_open[r] = 0
                    n_open -= 1
        for r in range(min(TILE, height - y0)):
            for i in range(min(TILE, width - x0)):
                o = r * TILE + i
                y, x = y0 + r, x0 + i
                rgb[y, x, 0] = state[_SUM_RED + o]
                rgb[y, x, 1] = state[_SUM_GREEN + o]
                rgb[y, x, 2] = state[_SUM_BLUE + o]
                depth[y, x] = state[_SUM_DEPTH + o]
                alpha_image[y, x] = _ONE - abs(state[o])
                if with_index:
                    dominant[y, x] = int(state[_DOMINANT + o])
                    first[y, x] = int(state[_FIRST + o])
                if with_hit:
                    hit[y, x] = int(state[_HIT + o]) if pixels.shape[0] == 0 or pixels[y, x] else -1


@njit(cache=True, error_model="numpy")
def _pass_through(state, rows_open, s, r0, r1, x0, y0):
    """Take what a frozen splat absorbs from T and from what is still to come; returns how many rows it finished."""
    dx = iota() + splat(f32(x0) + _HALF) - splat(s[U])
    zero = splat(_ZERO)
    q0 = splat(-_HALF * s[CONIC_A]) * dx * dx + splat(s[LN_OPACITY])
    q1 = splat(-s[CONIC_B]) * dx
    finished = 0
    for r in range(r0, r1):
        if rows_open[r] == 0:
            continue
        dy = f32(y0 + r) + _HALF - s[V]
        log_alpha = q1 * splat(dy) + (q0 + splat(-_HALF * s[CONIC_C] * dy * dy))
        seen = log_alpha >= splat(_LOG_ALPHA_MIN)
        if not any_lane(seen):
            continue
        o = r * TILE
        alpha = select(seen, minimum(exp(log_alpha), splat(_ALPHA_MAX)), zero)
        T = load(state, o)
        T_open = maximum(T, zero)
        w = alpha * T_open
        T_next = T_open - w
        goes_on = T_next >= splat(_T_MIN)
        w = select(goes_on, w, zero)
        T = select(goes_on, T_next, negative_abs(T))
        store(state, o, T)
        p = splat(s[RED]) * load(state, _V_RED + o) + splat(s[GREEN]) * load(state, _V_GREEN + o)
        p = p + splat(s[BLUE]) * load(state, _V_BLUE + o) + splat(s[DEPTH]) * load(state, _V_DEPTH + o)
        p = p + load(state, _V_ALPHA + o)
        store(state, _REST + o, load(state, _REST + o) - w * p)
        if not any_lane(zero < T):
            rows_open[r] = 0
            finished += 1
    return finished


@njit(parallel=True, cache=True, error_model="numpy")
def composite_backward(splats, lists, pixels, trained, image, v_image, pair_sums):
    """Per (tile, splat) sums of the loss gradient, written to ``pair_sums[slot[k]]`` [I, PAIR_SUMS].

    pixels: as given to the forward. trained: bool [N], rows whose sums are wanted, or [0] for all; the sums of the
    others are not written. image: as the forward made it. v_image: dL/d of it.
    With p_k = c_k . v_rgb + z_k v_depth + v_alpha:  dL/dalpha_k = T_k p_k - (sum_{j > k} w_j p_j) / (1 - alpha_k).
    The last sum starts as the whole pixel's, C . v_rgb + D v_depth + alpha v_alpha, and loses w_k p_k at each step.
    """
    ids, offset, slot = lists.ids, lists.offset, lists.slot
    all_trained, masked = trained.shape[0] == 0, pixels.shape[0] > 0
    rgb, depth, alpha_image = image.rgb, image.depth, image.alpha
    v_rgb, v_depth, v_alpha = v_image.rgb, v_image.depth, v_image.alpha
    height, width = depth.shape
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
        state = _zeros(_BACKWARD_STATE)
        rows_open = np.empty(TILE, np.uint8)
        n_open = _open_pixels(state, rows_open, pixels, x0, y0, width, height)
        for r in range(min(TILE, height - y0)):
            for i in range(min(TILE, width - x0)):
                o, y, x = r * TILE + i, y0 + r, x0 + i
                total = _ZERO
                for c in range(3):
                    state[_V_RED + c * PIXELS + o] = v_rgb[y, x, c]
                    total += rgb[y, x, c] * v_rgb[y, x, c]
                if v_depth.shape[0] > 0:
                    state[_V_DEPTH + o] = v_depth[y, x]
                    total += depth[y, x] * v_depth[y, x]
                if v_alpha.shape[0] > 0:
                    state[_V_ALPHA + o] = v_alpha[y, x]
                    total += alpha_image[y, x] * v_alpha[y, x]
                state[_REST + o] = total
        if masked:  # a loss may have no gradient there, not even a number
            for o in range(PIXELS):
                if state[o] < _ZERO:
                    for plane in range(_REST, _BACKWARD_STATE, PIXELS):
                        state[plane + o] = _ZERO
        centre_x = iota() + splat(f32(x0) + _HALF)
        zero, one, floor_T = splat(_ZERO), splat(_ONE), splat(_T_MIN)
        threshold, ceiling = splat(_LOG_ALPHA_MIN), splat(_ALPHA_MAX)
        for k in range(offset[tile], end):
            out = pair_sums[slot[k]]
            if n_open == 0:
                for i in range(PAIR_SUMS):
                    out[i] = _ZERO
                continue
            s = splats[ids[k]]
            r0 = max(0, int(np.ceil(s[V] - s[EXTENT_V] - _HALF)) - y0)
            r1 = min(min(TILE, height - y0), int(np.floor(s[V] + s[EXTENT_V] - _HALF)) + 1 - y0)
            if not (all_trained or trained[ids[k]]):
                n_open -= _pass_through(state, rows_open, s, r0, r1, x0, y0)
                continue
            dx = centre_x - splat(s[U])
            q0 = splat(-_HALF * s[CONIC_A]) * dx * dx + splat(s[LN_OPACITY])
            q1 = splat(-s[CONIC_B]) * dx
            red, green, blue, z = splat(s[RED]), splat(s[GREEN]), splat(s[BLUE]), splat(s[DEPTH])
            sum_g, sum_gy, sum_gyy = zero, zero, zero
            sum_r, sum_b, sum_gr, sum_z = zero, zero, zero, zero
            for r in range(r0, r1):
                if rows_open[r] == 0:
                    continue
                dy = f32(y0 + r) + _HALF - s[V]
                log_alpha = q1 * splat(dy) + (q0 + splat(-_HALF * s[CONIC_C] * dy * dy))
                seen = log_alpha >= threshold
                if not any_lane(seen):
                    continue
                o = r * TILE
                raw = exp(log_alpha)
                alpha = select(seen, minimum(raw, ceiling), zero)
                T = load(state, o)
                T_open = maximum(T, zero)
                w = alpha * T_open
                T_next = T_open - w
                goes_on = T_next >= floor_T
                w = select(goes_on, w, zero)
                T = select(goes_on, T_next, negative_abs(T))
                store(state, o, T)
                v_red, v_green, v_blue = load(state, _V_RED + o), load(state, _V_GREEN + o), load(state, _V_BLUE + o)
                v_z = load(state, _V_DEPTH + o)
                p = red * v_red + green * v_green + blue * v_blue + z * v_z + load(state, _V_ALPHA + o)
                rest = load(state, _REST + o) - w * p
                store(state, _REST + o, rest)
                v_of_alpha = T_open * p - rest / (one - alpha)
                g = select(goes_on & (seen & (raw < ceiling)), v_of_alpha * alpha, zero)
                gy = g * splat(dy)
                sum_g = sum_g + g
                sum_gy = sum_gy + gy
                sum_gyy = sum_gyy + gy * splat(dy)
                sum_r = sum_r + w * v_red
                sum_gr = sum_gr + w * v_green
                sum_b = sum_b + w * v_blue
                sum_z = sum_z + w * v_z
                if not any_lane(zero < T):
                    rows_open[r] = 0
                    n_open -= 1
            gx = sum_g * dx
            out[SUM_GX] = reduce_add(gx)
            out[SUM_GY] = reduce_add(sum_gy)
            out[SUM_GXX] = reduce_add(gx * dx)
            out[SUM_GXY] = reduce_add(sum_gy * dx)
            out[SUM_GYY] = reduce_add(sum_gyy)
            out[SUM_G] = reduce_add(sum_g)
            out[SUM_RED] = reduce_add(sum_r)
            out[SUM_GREEN] = reduce_add(sum_gr)
            out[SUM_BLUE] = reduce_add(sum_b)
            out[SUM_DEPTH] = reduce_add(sum_z)
