"""Which tiles of the image a splat's ellipse touches."""

import math

import numpy as np
from numba import njit

from gsfusion_nb.constants import ALPHA_MIN

from ..binning.tile_windows import FIRST_X, FIRST_Y, LAST_X, LAST_Y
from ..composite.layout import TILE
from ..runtime.numba import shared_cache as shared_cache  # before the functions are made
from .splat import CONIC_A, CONIC_B, CONIC_C, EXTENT_U, EXTENT_V, LN_OPACITY, U, V

f32 = np.float32
_HALF, _TWO, _ZERO = f32(0.5), f32(2.0), f32(0.0)
_LOG_ALPHA_MIN = f32(math.log(ALPHA_MIN))


@njit(cache=True, error_model="numpy")
def _band(splat, y_first, y_last):
    """Columns (first, last) of pixels whose centres the ellipse covers somewhere in the pixel rows y_first .. y_last.

    The ellipse's right edge x(y) = (-B dy + sqrt(B^2 dy^2 - A (C dy^2 - r))) / A is concave, so its largest value in
    the band is at the rightmost point's dy clamped to the band; the left edge likewise.
    """
    u, v, A, B, C = splat[U], splat[V], splat[CONIC_A], splat[CONIC_B], splat[CONIC_C]
    slack = f32(2e-3)  # for rounding: more entries, the same picture
    reach = _TWO * (splat[LN_OPACITY] - _LOG_ALPHA_MIN) + slack
    low = max(f32(y_first) + _HALF - v, -splat[EXTENT_V])
    high = min(f32(y_last) + _HALF - v, splat[EXTENT_V])
    dy = min(max(-B * splat[EXTENT_U] / C, low), high)
    right = (-B * dy + math.sqrt(max(B * B * dy * dy - A * (C * dy * dy - reach), _ZERO))) / A
    dy = min(max(B * splat[EXTENT_U] / C, low), high)
    left = (-B * dy - math.sqrt(max(B * B * dy * dy - A * (C * dy * dy - reach), _ZERO))) / A
    return int(math.ceil(u + left - _HALF)), int(math.floor(u + right - _HALF))


@njit(cache=True, error_model="numpy")
def tiles_of(splat, width, height, windows, tiles, start, room):
    """Number of tiles that the splat touches; the numbers of the first ``room`` of them go to ``tiles[start:]``.

    Only tiles count in whose window (``binning.tile_windows``) it can be seen; an empty array stands for whole tiles.
    """
    y_first = max(0, int(math.ceil(splat[V] - splat[EXTENT_V] - _HALF)))
    y_last = min(height - 1, int(math.floor(splat[V] + splat[EXTENT_V] - _HALF)))
    tiles_x = (width + TILE - 1) // TILE
    n = 0
    masked = windows.shape[0] > 0
    if y_first > y_last:
        return n
    for ty in range(y_first // TILE, y_last // TILE + 1):
        left, right = _band(splat, max(y_first, ty * TILE), min(y_last, ty * TILE + TILE - 1))
        left, right = max(left, 0), min(right, width - 1)
        if left > right:
            continue
        for tx in range(left // TILE, right // TILE + 1):
            if masked:
                t = ty * tiles_x + tx
                beside = (left > windows[t, LAST_X]) | (right < windows[t, FIRST_X])
                if beside | (y_first > windows[t, LAST_Y]) | (y_last < windows[t, FIRST_Y]):
                    continue
            if n < room:
                tiles[start + n] = ty * tiles_x + tx
            n += 1
    return n
