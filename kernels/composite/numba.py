"""Front-to-back compositing of sorted splats, one 16x16 tile at a time, one pixel row per vector;
its gradient is beside it.

State per tile is a row-major 16x16 array of the transmittance T; a finished pixel keeps its T with
the sign flipped, and one that is not to be drawn, or lies beyond the image, starts as finished.
Other planes of the same size follow.

The gradient walks front to back like the forward pass: it repeats the forward decisions exactly,
and the part of the pixel still to come is what is left of the total, so nothing per pair has to be
kept between the passes.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false

import numpy as np
from numba import njit, prange

from gsfusion_nb.render.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

from ..project.layout import (
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
from ..runtime.numba.scalars import cyclic_size, cyclic_task
from ..runtime.numba.simd import (
    absolute,
    any_lane,
    either,
    exp,
    iota,
    load,
    maximum,
    minimum,
    negative_abs,
    select,
    splat,
    store,
    store_triples,
    store_wide,
)
from . import layout as pair

PIXELS = pair.TILE * pair.TILE

f32 = np.float32
HALF = f32(0.5)
ONE = f32(1.0)
ZERO = f32(0.0)
CEILING = f32(ALPHA_MAX)
_LOG_ALPHA_MIN = f32(np.log(ALPHA_MIN))
_T_MIN = f32(TRANSMITTANCE_MIN)


@njit(cache=True, error_model="numpy")
def zeros(size):
    """float32 zeros that begin on a cache line: a vector that straddles two costs twice, 5 % of the
    whole."""
    line = 16
    memory = np.zeros(size + line, np.float32)
    skip = -(memory.ctypes.data // 4) % line
    return memory[skip : skip + size]


@njit(cache=True, error_model="numpy")
def open_pixels(state, rows_open, pixels, x0, y0, width, height):
    """T in front of the first splat: 1 at the tile's pixels that are to be drawn, else -1. Returns
    the open rows."""
    tile_width = min(pair.TILE, width - x0)
    tile_height = min(pair.TILE, height - y0)
    has_mask = pixels.shape[0] > 0
    if not has_mask and tile_width == pair.TILE and tile_height == pair.TILE:
        state[:PIXELS] = ONE
        rows_open[:] = 1
        return pair.TILE
    state[:PIXELS] = -ONE
    rows_open[:] = 0
    n_open = 0
    for r in range(tile_height):
        for i in range(tile_width):
            if not has_mask or pixels[y0 + r, x0 + i]:
                state[r * pair.TILE + i] = ONE
                rows_open[r] = 1
        n_open += rows_open[r]
    return n_open


@njit(inline="always")
def rows_of(s, y0, height):
    """The rows of the tile at ``y0`` that splat ``s`` reaches: the first, and the one behind the
    last."""
    first = max(0, int(np.ceil(s[V] - s[EXTENT_V] - HALF)) - y0)
    return first, min(
        min(pair.TILE, height - y0), int(np.floor(s[V] + s[EXTENT_V] - HALF)) + 1 - y0
    )


@njit(inline="always")
def across(s, x0):
    """What is the same in all rows of the tile at ``x0``: dx, and q0 and q1 of  ln alpha = q0 + q1
    dy - C dy^2 / 2."""
    dx = iota() + splat(f32(x0) + HALF) - splat(s[U])
    q0 = splat(-HALF * s[CONIC_A]) * dx * dx + splat(s[LN_OPACITY])
    return dx, q0, splat(-s[CONIC_B]) * dx


@njit(inline="always")
def row_exponent(s, q0, q1, dy):
    """ln alpha along a row, and where it is large enough to be seen."""
    log_alpha = q1 * splat(dy) + (q0 + splat(-HALF * s[CONIC_C] * dy * dy))
    return log_alpha, log_alpha >= splat(_LOG_ALPHA_MIN)


@njit(inline="always")
def absorb(state, o, alpha):
    """Let a splat absorb its share ``alpha`` of T in the row at ``o``.

    Returns the weights T alpha, zero where the pixel finishes; T before; T after; and which pixels
    go on.
    """
    T = load(state, o)
    T_open = maximum(T, splat(ZERO))
    w = alpha * T_open
    T_next = T_open - w
    goes_on = T_next >= splat(_T_MIN)
    T = select(goes_on, T_next, negative_abs(T))
    store(state, o, T)
    return select(goes_on, w, splat(ZERO)), T_open, T, goes_on


@njit(inline="always")
def alpha_of(log_alpha, visible):
    """alpha, cut at its ceiling, zero where the splat is not seen."""
    return select(visible, minimum(exp(log_alpha), splat(CEILING)), splat(ZERO))


_SUM_RED, _SUM_GREEN, _SUM_BLUE, _SUM_DEPTH, _HEAVIEST, _DOMINANT, _FIRST, _HIT = range(
    PIXELS, 9 * PIXELS, PIXELS
)
"""Where the planes of the forward pass begin in a tile's state, after T: sums of w c, the largest
w, indices."""

_FORWARD_STATE = 9 * PIXELS
_FORWARD_STATE_WITHOUT_HITS = 8 * PIXELS


@njit(parallel=True, cache=True, error_model="numpy")
def composite_forward(splats, lists, pixels, image, indices, opaque):
    """Blend every tile's splats into ``image`` and ``indices``.

    splats [N, SPLAT]: see ``project.layout``. pixels: bool [H, W], those to be drawn, or [0, 0] for
    all. opaque: a hit is the first splat with at least this alpha, even behind the one that
    finishes the pixel.
    """
    ids = lists.ids
    offset = lists.offset
    height, width = image.depth.shape
    with_index = indices.first.shape[0] > 0
    with_hit = indices.hit.shape[0] > 0
    tiles_x = (width + pair.TILE - 1) // pair.TILE
    tiles_y = (height + pair.TILE - 1) // pair.TILE
    n_tiles = tiles_x * tiles_y
    for k_tile in prange(cyclic_size(n_tiles)):
        tile = cyclic_task(k_tile, n_tiles)
        if tile >= n_tiles:
            continue
        x0 = (tile % tiles_x) * pair.TILE
        y0 = (tile // tiles_x) * pair.TILE
        if offset[tile] == offset[tile + 1]:
            _clear(x0, y0, image, indices)
            continue
        state = zeros(_FORWARD_STATE if with_hit else _FORWARD_STATE_WITHOUT_HITS)
        state[_DOMINANT:] = -ONE
        rows_open = np.empty(pair.TILE, np.uint8)
        n_open = open_pixels(state, rows_open, pixels, x0, y0, width, height)
        # finished pixels that still look for a hit keep their row open: -1 there, 0 at those not
        # drawn
        if with_hit:
            for o in range(PIXELS):
                state[_HIT + o] = -max(state[o], ZERO)
        for k in range(offset[tile], offset[tile + 1]):
            if n_open == 0:
                break
            s = splats[ids[k]]  # as float32 lanes: exact below 2^24
            number = splat(f32(ids[k]))
            first_row, end_row = rows_of(s, y0, height)
            _, q0, q1 = across(s, x0)
            for r in range(first_row, end_row):
                if rows_open[r] == 0:
                    continue
                log_alpha, visible = row_exponent(s, q0, q1, f32(y0 + r) + HALF - s[V])
                if not any_lane(visible):
                    continue
                o = r * pair.TILE
                alpha = alpha_of(log_alpha, visible)
                w, _, T, _ = absorb(state, o, alpha)
                _add_colour(state, o, w, s)
                if with_index:
                    _note_indices(state, o, w, number)
                open_lanes = splat(ZERO) < T
                if with_hit:
                    open_lanes = either(
                        open_lanes, _note_hit(state, o, alpha >= splat(opaque), number)
                    )
                if not any_lane(open_lanes):
                    rows_open[r] = 0
                    n_open -= 1
        _write_tile(state, x0, y0, image, indices, pixels)


@njit(cache=True, error_model="numpy")
def _clear(x0, y0, image, indices):
    """The background on one tile."""
    height, width = image.depth.shape
    for y in range(y0, min(y0 + pair.TILE, height)):
        for x in range(x0, min(x0 + pair.TILE, width)):
            image.rgb[y, x, 0] = ZERO
            image.rgb[y, x, 1] = ZERO
            image.rgb[y, x, 2] = ZERO
            image.depth[y, x] = ZERO
            image.alpha[y, x] = ZERO
    for index in (indices.first, indices.dominant, indices.hit):
        if index.shape[0] > 0:
            index[y0 : y0 + pair.TILE, x0 : x0 + pair.TILE] = -1


@njit(inline="always")
def _add_colour(state, o, w, s):
    """Add the weights of a splat, times its colour and depth, to the sums of the row at ``o``."""
    store(state, _SUM_RED + o, load(state, _SUM_RED + o) + w * splat(s[RED]))
    store(state, _SUM_GREEN + o, load(state, _SUM_GREEN + o) + w * splat(s[GREEN]))
    store(state, _SUM_BLUE + o, load(state, _SUM_BLUE + o) + w * splat(s[BLUE]))
    store(state, _SUM_DEPTH + o, load(state, _SUM_DEPTH + o) + w * splat(s[DEPTH]))


@njit(inline="always")
def _note_indices(state, o, w, number):
    """Keep the number of the splat where it is the heaviest so far, and where it is the first, in
    the pixels of the row at ``o``."""
    heaviest = load(state, _HEAVIEST + o)
    first = load(state, _FIRST + o)  # below 0 where there was none
    heavier = w > heaviest
    store(state, _HEAVIEST + o, select(heavier, w, heaviest))
    store(state, _DOMINANT + o, select(heavier, number, load(state, _DOMINANT + o)))
    store(state, _FIRST + o, select((w > splat(ZERO)) & (splat(ZERO) > first), number, first))


@njit(inline="always")
def _note_hit(state, o, solid, number):
    """Keep the number of the splat where it is the first ``solid`` one; which pixels still look for
    theirs."""
    old_hit = load(state, _HIT + o)
    new_hit = select(solid & (splat(ZERO) > old_hit), number, old_hit)
    store(state, _HIT + o, new_hit)
    return splat(ZERO) > new_hit


@njit(cache=True, error_model="numpy")
def _write_tile(state, x0, y0, image, indices, pixels):
    """The tile's sums and indices into the images."""
    height, width = image.depth.shape
    if x0 + pair.TILE > width:
        _write_pixels(state, x0, y0, image, indices, pixels)
        return
    with_index = indices.first.shape[0] > 0
    with_hit = indices.hit.shape[0] > 0
    rgb = image.rgb.reshape(-1)
    depth = image.depth.reshape(-1)
    alpha = image.alpha.reshape(-1)
    first = indices.first.reshape(-1)
    dominant = indices.dominant.reshape(-1)
    hit = indices.hit.reshape(-1)
    for r in range(min(pair.TILE, height - y0)):
        o = r * pair.TILE
        at = (y0 + r) * width + x0
        store_triples(
            rgb,
            3 * at,
            load(state, _SUM_RED + o),
            load(state, _SUM_GREEN + o),
            load(state, _SUM_BLUE + o),
        )
        store(depth, at, load(state, _SUM_DEPTH + o))
        store(alpha, at, splat(ONE) - absolute(load(state, o)))
        if with_index:
            store_wide(dominant, at, load(state, _DOMINANT + o))
            store_wide(first, at, load(state, _FIRST + o))
        if with_hit:
            store_wide(hit, at, load(state, _HIT + o))
            for i in range(pair.TILE if pixels.shape[0] > 0 else 0):
                if not pixels[y0 + r, x0 + i]:
                    hit[at + i] = -1


@njit(cache=True, error_model="numpy")
def _write_pixels(state, x0, y0, image, indices, pixels):
    """``_write_tile`` of a tile that reaches beyond the right border."""
    height, width = image.depth.shape
    with_index = indices.first.shape[0] > 0
    with_hit = indices.hit.shape[0] > 0
    for r in range(min(pair.TILE, height - y0)):
        for i in range(min(pair.TILE, width - x0)):
            o = r * pair.TILE + i
            y = y0 + r
            x = x0 + i
            image.rgb[y, x, 0] = state[_SUM_RED + o]
            image.rgb[y, x, 1] = state[_SUM_GREEN + o]
            image.rgb[y, x, 2] = state[_SUM_BLUE + o]
            image.depth[y, x] = state[_SUM_DEPTH + o]
            image.alpha[y, x] = ONE - abs(state[o])
            if with_index:
                indices.dominant[y, x] = int(state[_DOMINANT + o])
                indices.first[y, x] = int(state[_FIRST + o])
            if with_hit:
                indices.hit[y, x] = (
                    int(state[_HIT + o]) if pixels.shape[0] == 0 or pixels[y, x] else -1
                )
