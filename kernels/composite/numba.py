"""Front-to-back compositing of sorted splats, one 16x16 tile at a time, one pixel row per vector; gradient: ``vjp``."""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false

import numpy as np
from numba import njit, prange

from ..project.layout import BLUE, DEPTH, GREEN, RED, V
from ..runtime.numba.scalars import cyclic_size, cyclic_task
from ..runtime.numba.simd import any_lane, either, load, select, splat, store
from .front_to_back import (
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
from .layout import TILE

f32 = np.float32

_SUM_RED, _SUM_GREEN, _SUM_BLUE, _SUM_DEPTH, _HEAVIEST, _DOMINANT, _FIRST, _HIT = range(PIXELS, 9 * PIXELS, PIXELS)
"""Where the planes of the forward pass begin in a tile's state, after T: sums of w c, the largest w, indices."""

_FORWARD_STATE, _FORWARD_STATE_WITHOUT_HITS = 9 * PIXELS, 8 * PIXELS


@njit(parallel=True, cache=True, error_model="numpy")
def composite_forward(splats, lists, pixels, image, indices, opaque):
    """Blend every tile's splats into ``image`` and ``indices``.

    splats [N, SPLAT]: see ``project.layout``. pixels: bool [H, W], those to be drawn, or [0, 0] for all.
    opaque: a hit is the first splat with at least this alpha, even behind the one that finishes the pixel.
    """
    ids, offset = lists.ids, lists.offset
    height, width = image.depth.shape
    with_index, with_hit = indices.first.shape[0] > 0, indices.hit.shape[0] > 0
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    n_tiles = tiles_x * tiles_y
    for k_tile in prange(cyclic_size(n_tiles)):
        tile = cyclic_task(k_tile, n_tiles)
        if tile >= n_tiles:
            continue
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        if offset[tile] == offset[tile + 1]:
            _clear(x0, y0, image, indices)
            continue
        state = zeros(_FORWARD_STATE if with_hit else _FORWARD_STATE_WITHOUT_HITS)
        state[_DOMINANT:] = -ONE
        rows_open = np.empty(TILE, np.uint8)
        n_open = open_pixels(state, rows_open, pixels, x0, y0, width, height)
        if with_hit:  # finished pixels that still look for a hit keep their row open: -1 there, 0 at those not drawn
            for o in range(PIXELS):
                state[_HIT + o] = -max(state[o], ZERO)
        for k in range(offset[tile], offset[tile + 1]):
            if n_open == 0:
                break
            s, number = splats[ids[k]], splat(f32(ids[k]))  # as float32 lanes: exact below 2^24
            first_row, end_row = rows_of(s, y0, height)
            _, q0, q1 = across(s, x0)
            for r in range(first_row, end_row):
                if rows_open[r] == 0:
                    continue
                log_alpha, seen = row_exponent(s, q0, q1, f32(y0 + r) + HALF - s[V])
                if not any_lane(seen):
                    continue
                o = r * TILE
                alpha = alpha_of(log_alpha, seen)
                w, _, T, _ = absorb(state, o, alpha)
                _add_colour(state, o, w, s)
                if with_index:
                    _note_indices(state, o, w, number)
                open_lanes = splat(ZERO) < T
                if with_hit:
                    open_lanes = either(open_lanes, _note_hit(state, o, alpha >= splat(opaque), number))
                if not any_lane(open_lanes):
                    rows_open[r] = 0
                    n_open -= 1
        _write_tile(state, x0, y0, image, indices, pixels)


@njit(cache=True, error_model="numpy")
def _clear(x0, y0, image, indices):
    """The background on one tile."""
    height, width = image.depth.shape
    for y in range(y0, min(y0 + TILE, height)):
        for x in range(x0, min(x0 + TILE, width)):
            image.rgb[y, x, 0], image.rgb[y, x, 1], image.rgb[y, x, 2] = ZERO, ZERO, ZERO
            image.depth[y, x], image.alpha[y, x] = ZERO, ZERO
    for index in (indices.first, indices.dominant, indices.hit):
        if index.shape[0] > 0:
            index[y0 : y0 + TILE, x0 : x0 + TILE] = -1


@njit(inline="always")
def _add_colour(state, o, w, s):
    """Add the weights of a splat, times its colour and depth, to the sums of the row at ``o``."""
    store(state, _SUM_RED + o, load(state, _SUM_RED + o) + w * splat(s[RED]))
    store(state, _SUM_GREEN + o, load(state, _SUM_GREEN + o) + w * splat(s[GREEN]))
    store(state, _SUM_BLUE + o, load(state, _SUM_BLUE + o) + w * splat(s[BLUE]))
    store(state, _SUM_DEPTH + o, load(state, _SUM_DEPTH + o) + w * splat(s[DEPTH]))


@njit(inline="always")
def _note_indices(state, o, w, number):
    """Keep the number of the splat where it is the heaviest so far, and where it is the first."""
    heaviest, first = load(state, _HEAVIEST + o), load(state, _FIRST + o)
    heavier = w > heaviest
    store(state, _HEAVIEST + o, select(heavier, w, heaviest))
    store(state, _DOMINANT + o, select(heavier, number, load(state, _DOMINANT + o)))
    store(state, _FIRST + o, select((w > splat(ZERO)) & (splat(ZERO) > first), number, first))


@njit(inline="always")
def _note_hit(state, o, solid, number):
    """Keep the number of the splat where it is the first ``solid`` one; which pixels still look for theirs."""
    before = load(state, _HIT + o)
    now = select(solid & (splat(ZERO) > before), number, before)
    store(state, _HIT + o, now)
    return splat(ZERO) > now


@njit(cache=True, error_model="numpy")
def _write_tile(state, x0, y0, image, indices, pixels):
    """The tile's sums and indices into the images."""
    height, width = image.depth.shape
    with_index, with_hit = indices.first.shape[0] > 0, indices.hit.shape[0] > 0
    for r in range(min(TILE, height - y0)):
        for i in range(min(TILE, width - x0)):
            o = r * TILE + i
            y, x = y0 + r, x0 + i
            image.rgb[y, x, 0] = state[_SUM_RED + o]
            image.rgb[y, x, 1] = state[_SUM_GREEN + o]
            image.rgb[y, x, 2] = state[_SUM_BLUE + o]
            image.depth[y, x] = state[_SUM_DEPTH + o]
            image.alpha[y, x] = ONE - abs(state[o])
            if with_index:
                indices.dominant[y, x] = int(state[_DOMINANT + o])
                indices.first[y, x] = int(state[_FIRST + o])
            if with_hit:
                indices.hit[y, x] = int(state[_HIT + o]) if pixels.shape[0] == 0 or pixels[y, x] else -1
