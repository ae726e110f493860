"""A Gaussian before the camera: its centre and axes, the tiles that it covers, the gradient of its centre."""

import math

import numpy as np
from numba import njit

from gsfusion_nb.render.constants import ALPHA_MIN

from ..binning.layout import FIRST_X, FIRST_Y, LAST_X, LAST_Y
from ..composite.layout import SUM_GX, SUM_GY, TILE
from ..runtime.numba import shared_cache as shared_cache  # before the functions are made
from .layout import (
    CENTRE_X,
    CENTRE_Y,
    CENTRE_Z,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    EXTENT_U,
    EXTENT_V,
    LN_OPACITY,
    R00,
    R01,
    R02,
    R10,
    R11,
    R12,
    R20,
    R21,
    R22,
    T0,
    T1,
    T2,
    U,
    V,
)

f32 = np.float32
_ONE, _TWO = f32(1.0), f32(2.0)
_SMALL = f32(1e-12)


@njit(inline="always")
def camera_point(cam, X, Y, Z):
    """A point of the world in the camera frame."""
    x = cam[R00] * X + cam[R01] * Y + cam[R02] * Z + cam[T0]
    y = cam[R10] * X + cam[R11] * Y + cam[R12] * Z + cam[T1]
    z = cam[R20] * X + cam[R21] * Y + cam[R22] * Z + cam[T2]
    return x, y, z


@njit(inline="always")
def direction(cam, X, Y, Z):
    """Unit vector from the camera's centre to a point of the world, and 1 / its distance."""
    dx, dy, dz = X - cam[CENTRE_X], Y - cam[CENTRE_Y], Z - cam[CENTRE_Z]
    inv = _ONE / max(math.sqrt(dx * dx + dy * dy + dz * dz), _SMALL)
    return dx * inv, dy * inv, dz * inv, inv


@njit(inline="always")
def rotation(q):
    """|q| and the entries of R(q / |q|), row by row."""
    norm = max(math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), _SMALL)
    w, x, y, z = q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm
    return (
        norm,
        _ONE - _TWO * (y * y + z * z), _TWO * (x * y - w * z), _TWO * (x * z + w * y),
        _TWO * (x * y + w * z), _ONE - _TWO * (x * x + z * z), _TWO * (y * z - w * x),
        _TWO * (x * z - w * y), _TWO * (y * z + w * x), _ONE - _TWO * (x * x + y * y),
    )  # fmt: skip


@njit(inline="always")
def clamp(x, limit):
    """x, between -limit and limit."""
    return min(max(x, -limit), limit)


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


@njit(cache=True, error_model="numpy")
def centre_vjp(splats, start, trained, pair_sums, v_uv):
    """Write dL/d(u, v) to every row of ``v_uv`` [N, 2]; arguments as for ``vjp.project_rows_vjp``.

    ln alpha = ln o - (A dx^2 + C dy^2) / 2 - B dx dy with (dx, dy) = pixel - (u, v), so v_u = A sum g dx + B sum g dy.
    """
    all_trained = trained.shape[0] == 0
    for i in range(v_uv.shape[0]):
        g_x, g_y = np.float32(0.0), np.float32(0.0)
        v_uv[i] = g_x
        if start[i] == start[i + 1] or not (all_trained or trained[i]):
            continue
        for slot in range(start[i], start[i + 1]):
            g_x += pair_sums[slot, SUM_GX]
            g_y += pair_sums[slot, SUM_GY]
        s = splats[i]
        v_uv[i, 0] = s[CONIC_A] * g_x + s[CONIC_B] * g_y
        v_uv[i, 1] = s[CONIC_B] * g_x + s[CONIC_C] * g_y


@njit(cache=True, error_model="numpy")
def row_sums(start, trained, abs_sums, v_uv_abs):
    """Write the sum of |dL/d(u, v)| over the pixels to every row of ``v_uv_abs`` [N, 2]; ``abs_sums``: over those of
    each tile, from ``composite_backward``."""
    all_trained = trained.shape[0] == 0
    for i in range(v_uv_abs.shape[0]):
        u, v = np.float32(0.0), np.float32(0.0)
        if all_trained or trained[i]:
            for slot in range(start[i], start[i + 1]):
                u += abs_sums[slot, 0]
                v += abs_sums[slot, 1]
        v_uv_abs[i, 0], v_uv_abs[i, 1] = u, v
