"""The steps that both passes of the numba kernels take: a tile's state T, and what a splat takes from it, row by row.

State per tile is a row-major 16x16 array of the transmittance T; a finished pixel keeps its T with the sign flipped,
and one that is not to be drawn, or lies beyond the image, starts as finished. Other planes of the same size follow.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

import numpy as np
from numba import njit

from gsfusion_nb.render.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

from ..project.layout import CONIC_A, CONIC_B, CONIC_C, EXTENT_V, LN_OPACITY, U, V
from ..runtime.numba.simd import exp, iota, load, maximum, minimum, negative_abs, select, splat, store
from .layout import TILE

PIXELS = TILE * TILE

f32 = np.float32
HALF, ONE, ZERO = f32(0.5), f32(1.0), f32(0.0)
CEILING = f32(ALPHA_MAX)
_LOG_ALPHA_MIN, _T_MIN = f32(np.log(ALPHA_MIN)), f32(TRANSMITTANCE_MIN)


@njit(cache=True, error_model="numpy")
def zeros(size):
    """float32 zeros that begin on a cache line: a vector that straddles two costs twice, 5 % of the whole."""
    line = 16
    memory = np.zeros(size + line, np.float32)
    skip = -(memory.ctypes.data // 4) % line
    return memory[skip : skip + size]


@njit(cache=True, error_model="numpy")
def open_pixels(state, rows_open, pixels, x0, y0, width, height):
    """T in front of the first splat: 1 at the tile's pixels that are to be drawn, else -1. Returns the open rows."""
    tile_width, tile_height = min(TILE, width - x0), min(TILE, height - y0)
    masked = pixels.shape[0] > 0
    if not masked and tile_width == TILE and tile_height == TILE:
        state[:PIXELS] = ONE
        rows_open[:] = 1
        return TILE
    state[:PIXELS] = -ONE
    rows_open[:] = 0
    n_open = 0
    for r in range(tile_height):
        for i in range(tile_width):
            if not masked or pixels[y0 + r, x0 + i]:
                state[r * TILE + i] = ONE
                rows_open[r] = 1
        n_open += rows_open[r]
    return n_open


@njit(inline="always")
def rows_of(s, y0, height):
    """The rows of the tile at ``y0`` that splat ``s`` reaches: the first, and the one behind the last."""
    first = max(0, int(np.ceil(s[V] - s[EXTENT_V] - HALF)) - y0)
    return first, min(min(TILE, height - y0), int(np.floor(s[V] + s[EXTENT_V] - HALF)) + 1 - y0)


@njit(inline="always")
def across(s, x0):
    """What is the same in all rows of the tile at ``x0``: dx, and q0 and q1 of  ln alpha = q0 + q1 dy - C dy^2 / 2."""
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

    Returns the weights T alpha, zero where the pixel finishes; T before; T after; and which pixels go on.
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
def alpha_of(log_alpha, seen):
    """alpha, cut at its ceiling, zero where the splat is not seen."""
    return select(seen, minimum(exp(log_alpha), splat(CEILING)), splat(ZERO))
