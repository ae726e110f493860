"""Projection, colour and tile test of every Gaussian, in one pass over the rows; the gradient, in
another, is beside it.

Formulas and names are those of ``render.project`` and ``geometry.spherical_harmonics`` of
gsfusion_nb, unrolled to scalars here, so that a row is read once and its intermediate values stay
in registers.
"""

import math

import numpy as np
from numba import njit, prange

from gsfusion_nb.render.constants import ALPHA_MIN, FARTHEST_PX, SCREEN_BLUR_PX2
from gsfusion_nb.types import GaussianParams

from ..binning.layout import FIRST_X, FIRST_Y, LAST_X, LAST_Y, TileWindows
from ..composite import layout as pair
from ..harmonics.numba import basis_into
from ..runtime.numba import shared_cache as shared_cache  # before the functions are made
from ..runtime.numba.launch import scratch
from ..runtime.numba.scalars import cyclic_size, cyclic_task, kernel_part
from . import layout as col
from .layout import arrays_of

f32 = np.float32
_SMALL = f32(1e-12)
_BLUR = f32(SCREEN_BLUR_PX2)
_FARTHEST = f32(FARTHEST_PX)
_INFINITE = f32(np.inf)
_ALPHA_MIN = f32(ALPHA_MIN)
_LOG_ALPHA_MIN = f32(math.log(ALPHA_MIN))
_BEYOND = f32(1.01 * math.sqrt(-2.0 * math.log(ALPHA_MIN)))
"""Standard deviations at which the most opaque splat is below 1/255, and a little for rounding."""
_HALF = f32(0.5)
_ONE = f32(1.0)
_TWO = f32(2.0)
_ZERO = f32(0.0)

CHUNK = 256
"""Rows that one thread takes at a time."""

NOTED_PER_CHUNK = 16 * CHUNK
"""Tiles of a chunk's splats that are noted while they are counted; if there are more, they are
found a second time."""


@kernel_part
def camera_point(cam, X, Y, Z):
    """A point of the world in the camera frame."""
    x = cam[col.R00] * X + cam[col.R01] * Y + cam[col.R02] * Z + cam[col.T0]
    y = cam[col.R10] * X + cam[col.R11] * Y + cam[col.R12] * Z + cam[col.T1]
    z = cam[col.R20] * X + cam[col.R21] * Y + cam[col.R22] * Z + cam[col.T2]
    return x, y, z


@kernel_part
def direction(cam, X, Y, Z):
    """Unit vector from the camera's centre to a point of the world, and 1 / its distance."""
    dx = X - cam[col.CENTRE_X]
    dy = Y - cam[col.CENTRE_Y]
    dz = Z - cam[col.CENTRE_Z]
    inv = _ONE / max(math.sqrt(dx * dx + dy * dy + dz * dz), _SMALL)
    return dx * inv, dy * inv, dz * inv, inv


@kernel_part
def rotation(q):
    """|q| and the entries of R(q / |q|), row by row."""
    norm = max(math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), _SMALL)
    w = q[0] / norm
    x = q[1] / norm
    y = q[2] / norm
    z = q[3] / norm
    return (
        norm,
        _ONE - _TWO * (y * y + z * z),
        _TWO * (x * y - w * z),
        _TWO * (x * z + w * y),
        _TWO * (x * y + w * z),
        _ONE - _TWO * (x * x + z * z),
        _TWO * (y * z - w * x),
        _TWO * (x * z - w * y),
        _TWO * (y * z + w * x),
        _ONE - _TWO * (x * x + y * y),
    )


@kernel_part
def clamp(x, limit):
    """x, between -limit and limit."""
    return min(max(x, -limit), limit)


@njit(cache=True, error_model="numpy")
def _band(splat, y_first, y_last):
    """Columns (first, last) of pixels whose centres the ellipse covers somewhere in the pixel rows
    y_first .. y_last.

    The ellipse's right edge x(y) = (-B dy + sqrt(B^2 dy^2 - A (C dy^2 - r))) / A is concave, so its
    largest value in the band is at the rightmost point's dy clamped to the band; the left edge
    likewise.
    """
    u = splat[col.U]
    v = splat[col.V]
    A = splat[col.CONIC_A]
    B = splat[col.CONIC_B]
    C = splat[col.CONIC_C]
    slack = f32(2e-3)  # for rounding: more entries, the same picture
    reach = _TWO * (splat[col.LN_OPACITY] - _LOG_ALPHA_MIN) + slack
    low = max(f32(y_first) + _HALF - v, -splat[col.EXTENT_V])
    high = min(f32(y_last) + _HALF - v, splat[col.EXTENT_V])
    dy = min(max(-B * splat[col.EXTENT_U] / C, low), high)
    right = (-B * dy + math.sqrt(max(B * B * dy * dy - A * (C * dy * dy - reach), _ZERO))) / A
    dy = min(max(B * splat[col.EXTENT_U] / C, low), high)
    left = (-B * dy - math.sqrt(max(B * B * dy * dy - A * (C * dy * dy - reach), _ZERO))) / A
    return int(math.ceil(u + left - _HALF)), int(math.floor(u + right - _HALF))


@njit(cache=True, error_model="numpy")
def tiles_of(splat, width, height, windows, tiles, start, room):
    """Number of tiles that the splat touches; the numbers of the first ``room`` of them go to
    ``tiles[start:]``.

    Only tiles count in whose window (``binning.tile_windows``) it can be seen; an empty array
    stands for whole tiles.
    """
    y_first = max(0, int(math.ceil(splat[col.V] - splat[col.EXTENT_V] - _HALF)))
    y_last = min(height - 1, int(math.floor(splat[col.V] + splat[col.EXTENT_V] - _HALF)))
    tiles_x = (width + pair.TILE - 1) // pair.TILE
    n = 0
    has_mask = windows.shape[0] > 0
    if y_first > y_last:
        return n
    for ty in range(y_first // pair.TILE, y_last // pair.TILE + 1):
        left, right = _band(
            splat, max(y_first, ty * pair.TILE), min(y_last, ty * pair.TILE + pair.TILE - 1)
        )
        left = max(left, 0)
        right = min(right, width - 1)
        if left > right:
            continue
        for tx in range(left // pair.TILE, right // pair.TILE + 1):
            if has_mask:
                t = ty * tiles_x + tx
                misses = (left > windows[t, LAST_X]) | (right < windows[t, FIRST_X])
                if misses | (y_first > windows[t, LAST_Y]) | (y_last < windows[t, FIRST_Y]):
                    continue
            if n < room:
                tiles[start + n] = ty * tiles_x + tx
            n += 1
    return n


def project(
    params: GaussianParams, cam: np.ndarray, tiles: TileWindows
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``splats``, ``count`` and ``noted`` of ``project_rows``; only inside ``launching``."""
    N = len(params)
    splats = np.empty((N, col.SPLAT), np.float32)
    count = np.empty(N, np.int32)
    tile_notes = scratch("noted_tiles", -(-N // CHUNK) * NOTED_PER_CHUNK).view(np.int32)
    project_rows(arrays_of(params), cam, tiles, splats, count, tile_notes)
    return splats, count, tile_notes


@njit(parallel=True, cache=True, error_model="numpy")
def project_rows(params, cam, tiles, splats, count, tile_notes):
    """Fill ``splats`` [N, SPLAT] and ``count`` [N], the number of tiles each is listed in (0: not
    drawn).

    tiles: ``TileWindows``, where there are pixels to be drawn.
    tile_notes: for each chunk ``NOTED_PER_CHUNK`` numbers, the tiles of its rows one after another,
    as far as they fit.
    """
    xyz = params.xyz
    log_scale = params.log_scale
    quat = params.quat
    logit = params.logit
    sh = params.sh
    windows = tiles.windows
    sums = tiles.sums
    N = sh.shape[0]
    width = int(cam[col.WIDTH])
    height = int(cam[col.HEIGHT])
    n_parts = (N + CHUNK - 1) // CHUNK
    for k_part in prange(cyclic_size(n_parts)):
        part = cyclic_task(k_part, n_parts)
        if part >= n_parts:
            continue
        basis = np.empty(16, np.float32)
        first = part * CHUNK
        end = min(N, part * CHUNK + CHUNK)
        count[first:end] = 0
        candidates = np.empty(CHUNK, np.int32)
        n_noted = 0
        for j in range(_find_candidates(xyz, log_scale, cam, sums, first, end, candidates)):
            i = candidates[j]
            x, y, z = camera_point(cam, xyz[i, 0], xyz[i, 1], xyz[i, 2])
            opacity = _ONE / (_ONE + math.exp(-logit[i]))
            if not (z > cam[col.NEAR] and z <= cam[col.FAR] and opacity >= _ALPHA_MIN):
                continue
            s = splats[i]
            s[col.DEPTH] = z
            s[col.LN_OPACITY] = math.log(opacity)
            if not _project(cam, x, y, z, log_scale[i], quat[i], s):
                continue
            at = part * NOTED_PER_CHUNK + n_noted
            room = NOTED_PER_CHUNK - n_noted
            count[i] = tiles_of(s, width, height, windows, tile_notes, at, room)
            if count[i] == 0:
                continue
            if not _colour(cam, xyz[i], sh[i], basis, s):
                count[i] = 0
                continue
            n_noted = min(n_noted + count[i], NOTED_PER_CHUNK)


@njit(cache=True, error_model="numpy")
def _find_candidates(xyz, log_scale, cam, sums, first, end, candidates):
    """Write to ``candidates`` those of the rows first .. end - 1 that may touch a wanted pixel;
    returns their number.

    A box around the largest possible picture of a row is looked up in ``sums``
    (``binning.tile_windows``). There is no branch: which rows pass is random to the processor, and
    a wrong guess costs as much as the test.
    """
    fx = cam[col.FX]
    fy = cam[col.FY]
    near = cam[col.NEAR]
    width = int(cam[col.WIDTH])
    height = int(cam[col.HEIGHT])
    limit = f32(1e6)  # keeps the conversion to int defined
    n = 0
    for i in range(first, end):
        X = xyz[i, 0]
        Y = xyz[i, 1]
        Z = xyz[i, 2]
        x, y, z = camera_point(cam, X, Y, Z)
        inv_z = _ONE / max(z, near)
        x = x * inv_z
        y = y * inv_z
        tx = clamp(x, cam[col.LIMIT_X])
        ty = clamp(y, cam[col.LIMIT_Y])
        u = fx * x + cam[col.CX]
        v = fy * y + cam[col.CY]
        # the rows of J are fx/z sqrt(1 + tx^2) and fy/z sqrt(1 + ty^2) long
        size = math.exp(max(log_scale[i, 0], log_scale[i, 1], log_scale[i, 2])) * inv_z
        reach_u = _BEYOND * (fx * size * math.sqrt(_ONE + tx * tx) + _ONE)
        reach_v = _BEYOND * (fy * size * math.sqrt(_ONE + ty * ty) + _ONE)
        left = int(max(u - reach_u, -limit))
        right = int(min(u + reach_u, limit))
        top = int(max(v - reach_v, -limit))
        bottom = int(min(v + reach_v, limit))
        x0 = min(max(left, 0), width) // pair.TILE
        x1 = (min(max(right, -1), width - 1) + pair.TILE) // pair.TILE
        y0 = min(max(top, 0), height) // pair.TILE
        y1 = (min(max(bottom, -1), height - 1) + pair.TILE) // pair.TILE
        tiles = sums[y1, x1] - sums[y0, x1] - sums[y1, x0] + sums[y0, x0]
        candidates[n] = i
        n += int((z > near) & (tiles > 0))
    return n


@kernel_part
def _project(cam, x, y, z, log_scale, quat, s):
    """Centre, conic and extent of a Gaussian at (x, y, z) in the camera frame; whether they are
    within limits."""
    inv_z = _ONE / z
    u = cam[col.FX] * x * inv_z + cam[col.CX]
    v = cam[col.FY] * y * inv_z + cam[col.CY]
    tx = clamp(x * inv_z, cam[col.LIMIT_X])
    ty = clamp(y * inv_z, cam[col.LIMIT_Y])
    a = cam[col.FX] * inv_z
    b = cam[col.FY] * inv_z
    _, r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation(quat)
    s0 = math.exp(log_scale[0])
    s1 = math.exp(log_scale[1])
    s2 = math.exp(log_scale[2])
    # rows of J R_CW, then times each column of R_q S
    jx0 = a * (cam[col.R00] - tx * cam[col.R20])
    jy0 = b * (cam[col.R10] - ty * cam[col.R20])
    jx1 = a * (cam[col.R01] - tx * cam[col.R21])
    jy1 = b * (cam[col.R11] - ty * cam[col.R21])
    jx2 = a * (cam[col.R02] - tx * cam[col.R22])
    jy2 = b * (cam[col.R12] - ty * cam[col.R22])
    mu0 = (jx0 * r00 + jx1 * r10 + jx2 * r20) * s0
    mv0 = (jy0 * r00 + jy1 * r10 + jy2 * r20) * s0
    mu1 = (jx0 * r01 + jx1 * r11 + jx2 * r21) * s1
    mv1 = (jy0 * r01 + jy1 * r11 + jy2 * r21) * s1
    mu2 = (jx0 * r02 + jx1 * r12 + jx2 * r22) * s2
    mv2 = (jy0 * r02 + jy1 * r12 + jy2 * r22) * s2
    uu = mu0 * mu0 + mu1 * mu1 + mu2 * mu2
    vv = mv0 * mv0 + mv1 * mv1 + mv2 * mv2
    uv = mu0 * mv0 + mu1 * mv1 + mu2 * mv2
    c0 = mu1 * mv2 - mu2 * mv1
    c1 = mu2 * mv0 - mu0 * mv2
    c2 = mu0 * mv1 - mu1 * mv0
    cross2 = c0 * c0 + c1 * c1 + c2 * c2
    inv_det = _ONE / (cross2 + _BLUR * (uu + vv) + _BLUR * _BLUR)
    s[col.U] = u
    s[col.V] = v
    s[col.CONIC_A] = (vv + _BLUR) * inv_det
    s[col.CONIC_B] = -uv * inv_det
    s[col.CONIC_C] = (uu + _BLUR) * inv_det
    reach = _TWO * (s[col.LN_OPACITY] - _LOG_ALPHA_MIN)
    s[col.EXTENT_U] = math.sqrt(reach * (uu + _BLUR))
    s[col.EXTENT_V] = math.sqrt(reach * (vv + _BLUR))
    small = s[col.EXTENT_U] < _FARTHEST and s[col.EXTENT_V] < _FARTHEST
    return abs(u) < _FARTHEST and abs(v) < _FARTHEST and small


@kernel_part
def _colour(cam, xyz, sh, basis, s):
    """Colour of a Gaussian towards the camera; whether it is finite."""
    K = sh.shape[0]
    dx, dy, dz, _ = direction(cam, xyz[0], xyz[1], xyz[2])
    basis_into(dx, dy, dz, K, basis)
    red = _HALF
    green = _HALF
    blue = _HALF
    for k in range(K):
        red += basis[k] * sh[k, 0]
        green += basis[k] * sh[k, 1]
        blue += basis[k] * sh[k, 2]
    s[col.RED] = max(red, _ZERO)
    s[col.GREEN] = max(green, _ZERO)
    s[col.BLUE] = max(blue, _ZERO)
    return abs(red) < _INFINITE and abs(green) < _INFINITE and abs(blue) < _INFINITE
