"""Projection, colour and tile test of every Gaussian, in one pass over the rows; the gradient is in ``vjp``.

Formulas and names are those of ``render.project`` and ``geometry.spherical_harmonics`` of gsfusion_nb, unrolled to
scalars here, so that a row is read once and its intermediate values stay in registers.
"""

import math

import numpy as np
from numba import njit, prange

from gsfusion_nb.render.constants import ALPHA_MIN, FARTHEST_PX, NEAR_PLANE_M, SCREEN_BLUR_PX2

from ..composite.layout import TILE
from ..harmonics.numba import basis_into
from ..runtime.numba.scalars import cyclic_size, cyclic_task
from .geometry import camera_point, clamp, direction, rotation, tiles_of
from .layout import (
    BLUE,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    CX,
    CY,
    DEPTH,
    EXTENT_U,
    EXTENT_V,
    FX,
    FY,
    GREEN,
    HEIGHT,
    LIMIT_X,
    LIMIT_Y,
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
    RED,
    WIDTH,
    U,
    V,
)

f32 = np.float32
_NEAR = f32(NEAR_PLANE_M)
_BLUR = f32(SCREEN_BLUR_PX2)
_FARTHEST, _INFINITE = f32(FARTHEST_PX), f32(np.inf)
_ALPHA_MIN = f32(ALPHA_MIN)
_LOG_ALPHA_MIN = f32(math.log(ALPHA_MIN))
_BEYOND = f32(1.01 * math.sqrt(-2.0 * math.log(ALPHA_MIN)))
"""Standard deviations at which the most opaque splat is below 1/255, and a little for rounding."""
_HALF, _ONE, _TWO, _ZERO = f32(0.5), f32(1.0), f32(2.0), f32(0.0)

CHUNK = 256
"""Rows that one thread takes at a time."""

NOTED_PER_CHUNK = 16 * CHUNK
"""Tiles of a chunk's splats that are noted while they are counted; if there are more, they are found a second time."""


@njit(parallel=True, cache=True, error_model="numpy")
def project_rows(params, cam, wanted, splats, count, noted):
    """Fill ``splats`` [N, SPLAT] and ``count`` [N], the number of tiles each is listed in (0: not drawn).

    wanted: ``TileWindows``, where there are pixels to be drawn.
    noted: for each chunk ``NOTED_PER_CHUNK`` numbers, the tiles of its rows one after another, as far as they fit.
    """
    xyz, log_scale, quat, logit, sh = params.xyz, params.log_scale, params.quat, params.logit, params.sh
    windows, sums = wanted.windows, wanted.sums
    N = sh.shape[0]
    width, height = int(cam[WIDTH]), int(cam[HEIGHT])
    n_parts = (N + CHUNK - 1) // CHUNK
    for k_part in prange(cyclic_size(n_parts)):
        part = cyclic_task(k_part, n_parts)
        if part >= n_parts:
            continue
        basis = np.empty(16, np.float32)
        first, end = part * CHUNK, min(N, part * CHUNK + CHUNK)
        count[first:end] = 0
        candidates = np.empty(CHUNK, np.int32)
        n_noted = 0
        for j in range(_find_candidates(xyz, log_scale, cam, sums, first, end, candidates)):
            i = candidates[j]
            x, y, z = camera_point(cam, xyz[i, 0], xyz[i, 1], xyz[i, 2])
            opacity = _ONE / (_ONE + math.exp(-logit[i]))
            if not (z > _NEAR and opacity >= _ALPHA_MIN):
                continue
            s = splats[i]
            s[DEPTH], s[LN_OPACITY] = z, math.log(opacity)
            if not _project(cam, x, y, z, log_scale[i], quat[i], s):
                continue
            at, room = part * NOTED_PER_CHUNK + n_noted, NOTED_PER_CHUNK - n_noted
            count[i] = tiles_of(s, width, height, windows, noted, at, room)
            if count[i] == 0:
                continue
            if not _colour(cam, xyz[i], sh[i], basis, s):
                count[i] = 0
                continue
            n_noted = min(n_noted + count[i], NOTED_PER_CHUNK)


@njit(cache=True, error_model="numpy")
def _find_candidates(xyz, log_scale, cam, sums, first, end, found):
    """Write to ``found`` those of the rows first .. end - 1 that may touch a wanted pixel; returns their number.

    A box around the largest possible picture of a row is looked up in ``sums`` (``binning.tile_windows``). There is no
    branch: which rows pass is random to the processor, and a wrong guess costs as much as the test.
    """
    fx, fy = cam[FX], cam[FY]
    width, height = int(cam[WIDTH]), int(cam[HEIGHT])
    far = f32(1e6)  # keeps the conversion to int defined
    n = 0
    for i in range(first, end):
        X, Y, Z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        x, y, z = camera_point(cam, X, Y, Z)
        inv_z = _ONE / max(z, _NEAR)
        x, y = x * inv_z, y * inv_z
        tx, ty = clamp(x, cam[LIMIT_X]), clamp(y, cam[LIMIT_Y])
        u, v = fx * x + cam[CX], fy * y + cam[CY]
        # the rows of J are fx/z sqrt(1 + tx^2) and fy/z sqrt(1 + ty^2) long
        size = math.exp(max(log_scale[i, 0], log_scale[i, 1], log_scale[i, 2])) * inv_z
        reach_u = _BEYOND * (fx * size * math.sqrt(_ONE + tx * tx) + _ONE)
        reach_v = _BEYOND * (fy * size * math.sqrt(_ONE + ty * ty) + _ONE)
        left, right = int(max(u - reach_u, -far)), int(min(u + reach_u, far))
        top, bottom = int(max(v - reach_v, -far)), int(min(v + reach_v, far))
        x0, x1 = min(max(left, 0), width) // TILE, (min(max(right, -1), width - 1) + TILE) // TILE
        y0, y1 = min(max(top, 0), height) // TILE, (min(max(bottom, -1), height - 1) + TILE) // TILE
        tiles = sums[y1, x1] - sums[y0, x1] - sums[y1, x0] + sums[y0, x0]
        found[n] = i
        n += int((z > _NEAR) & (tiles > 0))
    return n


@njit(inline="always")
def _project(cam, x, y, z, log_scale, quat, s):
    """Centre, conic and extent of a Gaussian at (x, y, z) in the camera frame; whether they are within limits."""
    inv_z = _ONE / z
    u, v = cam[FX] * x * inv_z + cam[CX], cam[FY] * y * inv_z + cam[CY]
    tx, ty = clamp(x * inv_z, cam[LIMIT_X]), clamp(y * inv_z, cam[LIMIT_Y])
    a, b = cam[FX] * inv_z, cam[FY] * inv_z
    _, r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation(quat)
    s0, s1, s2 = math.exp(log_scale[0]), math.exp(log_scale[1]), math.exp(log_scale[2])
    # rows of J R_CW, then times each column of R_q S
    jx0, jy0 = a * (cam[R00] - tx * cam[R20]), b * (cam[R10] - ty * cam[R20])
    jx1, jy1 = a * (cam[R01] - tx * cam[R21]), b * (cam[R11] - ty * cam[R21])
    jx2, jy2 = a * (cam[R02] - tx * cam[R22]), b * (cam[R12] - ty * cam[R22])
    mu0, mv0 = (jx0 * r00 + jx1 * r10 + jx2 * r20) * s0, (jy0 * r00 + jy1 * r10 + jy2 * r20) * s0
    mu1, mv1 = (jx0 * r01 + jx1 * r11 + jx2 * r21) * s1, (jy0 * r01 + jy1 * r11 + jy2 * r21) * s1
    mu2, mv2 = (jx0 * r02 + jx1 * r12 + jx2 * r22) * s2, (jy0 * r02 + jy1 * r12 + jy2 * r22) * s2
    uu = mu0 * mu0 + mu1 * mu1 + mu2 * mu2
    vv = mv0 * mv0 + mv1 * mv1 + mv2 * mv2
    uv = mu0 * mv0 + mu1 * mv1 + mu2 * mv2
    c0, c1, c2 = mu1 * mv2 - mu2 * mv1, mu2 * mv0 - mu0 * mv2, mu0 * mv1 - mu1 * mv0
    cross2 = c0 * c0 + c1 * c1 + c2 * c2
    inv_det = _ONE / (cross2 + _BLUR * (uu + vv) + _BLUR * _BLUR)
    s[U], s[V] = u, v
    s[CONIC_A], s[CONIC_B], s[CONIC_C] = (vv + _BLUR) * inv_det, -uv * inv_det, (uu + _BLUR) * inv_det
    reach = _TWO * (s[LN_OPACITY] - _LOG_ALPHA_MIN)
    s[EXTENT_U], s[EXTENT_V] = math.sqrt(reach * (uu + _BLUR)), math.sqrt(reach * (vv + _BLUR))
    small = s[EXTENT_U] < _FARTHEST and s[EXTENT_V] < _FARTHEST
    return abs(u) < _FARTHEST and abs(v) < _FARTHEST and small


@njit(inline="always")
def _colour(cam, xyz, sh, basis, s):
    """Colour of a Gaussian towards the camera; whether it is finite."""
    K = sh.shape[0]
    dx, dy, dz, _ = direction(cam, xyz[0], xyz[1], xyz[2])
    basis_into(dx, dy, dz, K, basis)
    red, green, blue = _HALF, _HALF, _HALF
    for k in range(K):
        red += basis[k] * sh[k, 0]
        green += basis[k] * sh[k, 1]
        blue += basis[k] * sh[k, 2]
    s[RED], s[GREEN], s[BLUE] = max(red, _ZERO), max(green, _ZERO), max(blue, _ZERO)
    return abs(red) < _INFINITE and abs(green) < _INFINITE and abs(blue) < _INFINITE
