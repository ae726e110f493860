"""Projection, colour and tile test of every Gaussian, in one pass over the rows, and the gradient,
in another.

Formulas and names are those of ``render.project`` and ``geometry.spherical_harmonics`` of
gsfusion_nb, unrolled to scalars here, so that a row is read once and its intermediate values stay
in registers.
"""

import math
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.render.constants import ALPHA_MIN, FARTHEST_PX, SCREEN_BLUR_PX2
from gsfusion_nb.types import GaussianParams

from ..binning.layout import FIRST_X, FIRST_Y, LAST_X, LAST_Y, TileWindows
from ..composite import layout as pair
from ..harmonics.numba import basis_into, gradient_into
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


@njit(cache=True, error_model="numpy")
def centre_vjp(splats, start, train_rows, pair_sums, v_uv):
    """Write dL/d(u, v) to every row of ``v_uv`` [N, 2]; arguments as for ``project_rows_vjp``.

    ln alpha = ln o - (A dx^2 + C dy^2) / 2 - B dx dy with (dx, dy) = pixel - (u, v), so v_u = A sum
    g dx + B sum g dy.
    """
    all_trained = train_rows.shape[0] == 0
    for i in range(v_uv.shape[0]):
        g_x = np.float32(0.0)
        g_y = np.float32(0.0)
        v_uv[i] = g_x
        if start[i] == start[i + 1] or not (all_trained or train_rows[i]):
            continue
        for slot in range(start[i], start[i + 1]):
            g_x += pair_sums[slot, pair.SUM_GX]
            g_y += pair_sums[slot, pair.SUM_GY]
        s = splats[i]
        v_uv[i, 0] = s[col.CONIC_A] * g_x + s[col.CONIC_B] * g_y
        v_uv[i, 1] = s[col.CONIC_B] * g_x + s[col.CONIC_C] * g_y


@njit(cache=True, error_model="numpy")
def conic_vjp(start, train_rows, pair_sums, v_conic):
    """Write dL/d(A, B, C) to every row of ``v_conic`` [N, 3]; arguments as for
    ``project_rows_vjp``. From ln alpha as in ``centre_vjp``."""
    all_trained = train_rows.shape[0] == 0
    for i in range(v_conic.shape[0]):
        g_xx = np.float32(0.0)
        g_xy = np.float32(0.0)
        g_yy = np.float32(0.0)
        if all_trained or train_rows[i]:
            for slot in range(start[i], start[i + 1]):
                g_xx += pair_sums[slot, pair.SUM_GXX]
                g_xy += pair_sums[slot, pair.SUM_GXY]
                g_yy += pair_sums[slot, pair.SUM_GYY]
        v_conic[i, 0] = -_HALF * g_xx
        v_conic[i, 1] = -g_xy
        v_conic[i, 2] = -_HALF * g_yy


@njit(cache=True, error_model="numpy")
def row_sums(start, train_rows, abs_sums, v_uv_abs):
    """Write the sum of |dL/d(u, v)| over the pixels to every row of ``v_uv_abs`` [N, 2];
    ``abs_sums``: over those of each tile, from ``composite_backward``."""
    all_trained = train_rows.shape[0] == 0
    for i in range(v_uv_abs.shape[0]):
        u = np.float32(0.0)
        v = np.float32(0.0)
        if all_trained or train_rows[i]:
            for slot in range(start[i], start[i + 1]):
                u += abs_sums[slot, 0]
                v += abs_sums[slot, 1]
        v_uv_abs[i, 0] = u
        v_uv_abs[i, 1] = v


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


def gradients_of(
    saved: Any,
    train_rows: np.ndarray,
    sums: np.ndarray,
    abs_sums: np.ndarray | None,
    v_uv: Tensor | None,
    v_uv_abs: Tensor | None,
    v_conic: Tensor | None = None,
) -> GaussianParams:
    """dL/d of the parameters of a drawn map from the sums of its splats; also fills dL/d of centres
    and conics if asked to.

    Args:
        saved: The map, ``params``; its camera, ``lens``; ``splats`` and ``start``, as for
            ``project_rows_vjp``.
        train_rows, sums, abs_sums: As for ``project_rows_vjp`` and ``row_sums``.
        v_uv, v_uv_abs, v_conic: Of ``render_vjp``.
    """
    columns = vars(saved.params).items()
    gradients = GaussianParams(
        **{name: torch.empty_like(x, memory_format=torch.contiguous_format) for name, x in columns}
    )
    project_rows_vjp(
        arrays_of(saved.params),
        saved.lens,
        saved.splats,
        saved.start,
        train_rows,
        sums,
        arrays_of(gradients),
    )
    if v_uv is not None:
        plane = v_uv.contiguous()
        centre_vjp(saved.splats, saved.start, train_rows, sums, plane.numpy())
        v_uv.copy_(plane)
    if v_uv_abs is not None:
        plane = v_uv_abs.contiguous()
        row_sums(saved.start, train_rows, abs_sums, plane.numpy())
        v_uv_abs.copy_(plane)
    if v_conic is not None:
        plane = v_conic.contiguous()
        conic_vjp(saved.start, train_rows, sums, plane.numpy())
        v_conic.copy_(plane)
    return gradients


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


@njit(parallel=True, cache=True, error_model="numpy")
def project_rows_vjp(params, cam, splats, start, train_rows, pair_sums, v_params):
    """Add up each row's pair sums and carry them to its parameters; every row of the outputs is
    written.

    Rows outside ``train_rows`` get zero and their pair sums are not read; an empty array stands for
    all rows.
    """
    xyz = params.xyz
    log_scale = params.log_scale
    quat = params.quat
    sh = params.sh
    v_xyz = v_params.xyz
    v_log_scale = v_params.log_scale
    v_quat = v_params.quat
    v_logit = v_params.logit
    v_sh = v_params.sh
    all_trained = train_rows.shape[0] == 0
    N = sh.shape[0]
    n_parts = (N + CHUNK - 1) // CHUNK
    for k_part in prange(cyclic_size(n_parts)):
        part = cyclic_task(k_part, n_parts)
        if part >= n_parts:
            continue
        total = np.empty(pair.PAIR_SUMS, np.float32)
        basis = np.empty(16, np.float32)
        w = np.empty(16, np.float32)
        for i in range(part * CHUNK, min(N, part * CHUNK + CHUNK)):
            if start[i] == start[i + 1] or not (all_trained or train_rows[i]):
                v_xyz[i] = _ZERO
                v_log_scale[i] = _ZERO
                v_quat[i] = _ZERO
                v_logit[i] = _ZERO
                v_sh[i] = _ZERO
                continue
            total[:] = _ZERO
            for slot in range(start[i], start[i + 1]):
                for j in range(pair.PAIR_SUMS):
                    total[j] += pair_sums[slot, j]
            s = splats[i]
            v_logit[i] = total[pair.SUM_G] * (_ONE - math.exp(s[col.LN_OPACITY]))
            _project_vjp(
                cam, s, total, (xyz[i], log_scale[i], quat[i]), v_xyz[i], v_log_scale[i], v_quat[i]
            )
            _colour_vjp(cam, s, total, xyz[i], sh[i], (basis, w), v_xyz[i], v_sh[i])


@kernel_part
def _project_vjp(cam, s, total, row, v_xyz, v_log_scale, v_quat):
    """From the centre, the conic and the depth of a splat to its row: position, log scales,
    quaternion."""
    xyz, log_scale, quat = row
    # ln alpha = ln o - (A dx^2 + C dy^2) / 2 - B dx dy,  d = pixel - centre
    v_u = s[col.CONIC_A] * total[pair.SUM_GX] + s[col.CONIC_B] * total[pair.SUM_GY]
    v_v = s[col.CONIC_B] * total[pair.SUM_GX] + s[col.CONIC_C] * total[pair.SUM_GY]
    x, y, _ = camera_point(cam, xyz[0], xyz[1], xyz[2])
    inv_z = _ONE / s[col.DEPTH]
    x_z = x * inv_z
    y_z = y * inv_z
    tx = clamp(x_z, cam[col.LIMIT_X])
    ty = clamp(y_z, cam[col.LIMIT_Y])
    norm, r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation(quat)
    s0 = math.exp(log_scale[0])
    s1 = math.exp(log_scale[1])
    s2 = math.exp(log_scale[2])
    lens = (cam[col.FX] * inv_z, cam[col.FY] * inv_z, tx, ty)
    mu0, mv0, z0 = _column(cam, lens, r00, r10, r20, s0)
    mu1, mv1, z1 = _column(cam, lens, r01, r11, r21, s1)
    mu2, mv2, z2 = _column(cam, lens, r02, r12, r22, s2)
    nu0, nv0, nu1, nv1, nu2, nv2 = _solved(mu0, mv0, mu1, mv1, mu2, mv2)
    l0, v_mu0, v_mv0 = _column_vjp(s, total, nu0, nv0)
    l1, v_mu1, v_mv1 = _column_vjp(s, total, nu1, nv1)
    l2, v_mu2, v_mv2 = _column_vjp(s, total, nu2, nv2)
    v_log_scale[0] = l0
    v_log_scale[1] = l1
    v_log_scale[2] = l2
    g00, g10, g20 = _rotation_column_vjp(cam, lens, v_mu0, v_mv0, s0)
    g01, g11, g21 = _rotation_column_vjp(cam, lens, v_mu1, v_mv1, s1)
    g02, g12, g22 = _rotation_column_vjp(cam, lens, v_mu2, v_mv2, s2)
    _quaternion_vjp(quat, norm, (g00, g01, g02, g10, g11, g12, g20, g21, g22), v_quat)
    v_tx = -lens[0] * (z0 * v_mu0 + z1 * v_mu1 + z2 * v_mu2)
    v_ty = -lens[1] * (z0 * v_mv0 + z1 * v_mv1 + z2 * v_mv2)
    v_xz = cam[col.FX] * v_u + (v_tx if tx == x_z else _ZERO)
    v_yz = cam[col.FY] * v_v + (v_ty if ty == y_z else _ZERO)
    d0 = v_xz * inv_z
    d1 = v_yz * inv_z
    # J is as 1/z: m . v_m in all
    d2 = total[pair.SUM_DEPTH] - inv_z * (x_z * v_xz + y_z * v_yz + l0 + l1 + l2)
    v_xyz[0] = cam[col.R00] * d0 + cam[col.R10] * d1 + cam[col.R20] * d2
    v_xyz[1] = cam[col.R01] * d0 + cam[col.R11] * d1 + cam[col.R21] * d2
    v_xyz[2] = cam[col.R02] * d0 + cam[col.R12] * d1 + cam[col.R22] * d2


@kernel_part
def _column(cam, lens, q0, q1, q2, scale):
    """A column m (2) of M = J B, and z of that column of B = R_CW R_q S."""
    a, b, tx, ty = lens
    x = (cam[col.R00] * q0 + cam[col.R01] * q1 + cam[col.R02] * q2) * scale
    y = (cam[col.R10] * q0 + cam[col.R11] * q1 + cam[col.R12] * q2) * scale
    z = (cam[col.R20] * q0 + cam[col.R21] * q1 + cam[col.R22] * q2) * scale
    return a * (x - tx * z), b * (y - ty * z), z


@kernel_part
def _solved(mu0, mv0, mu1, mv1, mu2, mv2):
    """n_j = Q m_j of the columns of M, where Q is the inverse of cov = M M^T + blur I.

    n_j = (sum_k (m_k x m_j) (-m_kv, m_ku) + blur m_j) / det: the term of k = j, which is large for
    a needle, is zero. A mu + B mv, with the conic, would be a difference of large numbers.
    """
    c0 = mu1 * mv2 - mu2 * mv1
    c1 = mu2 * mv0 - mu0 * mv2
    c2 = mu0 * mv1 - mu1 * mv0
    trace = mu0 * mu0 + mu1 * mu1 + mu2 * mu2 + mv0 * mv0 + mv1 * mv1 + mv2 * mv2
    inv_det = _ONE / (c0 * c0 + c1 * c1 + c2 * c2 + _BLUR * trace + _BLUR * _BLUR)
    return (
        (c2 * mv1 - c1 * mv2 + _BLUR * mu0) * inv_det,
        (c1 * mu2 - c2 * mu1 + _BLUR * mv0) * inv_det,
        (c0 * mv2 - c2 * mv0 + _BLUR * mu1) * inv_det,
        (c2 * mu0 - c0 * mu2 + _BLUR * mv1) * inv_det,
        (c1 * mv0 - c0 * mv1 + _BLUR * mu2) * inv_det,
        (c0 * mu1 - c1 * mu0 + _BLUR * mv2) * inv_det,
    )


@kernel_part
def _column_vjp(s, total, n_u, n_v):
    """From n = Q m and the sums of a splat: m . v_m, which is dL/d of the log scale of the column
    m, and v_m (2).

    v_cov = -Q v_Q Q and v_m = 2 v_cov m = -2 Q (v_Q n), so m . v_m = -2 n . (v_Q n). For a needle m
    . (2 v_cov m) loses all digits in float32: the entries of v_cov are as large as 1 / blur^2, and
    along the needle they cancel.
    """
    # v_A = -SUM_GXX / 2, v_B = -SUM_GXY (two entries of Q, each half), v_C = -SUM_GYY / 2
    w_u = total[pair.SUM_GXX] * n_u + total[pair.SUM_GXY] * n_v
    w_v = total[pair.SUM_GXY] * n_u + total[pair.SUM_GYY] * n_v
    v_mu = s[col.CONIC_A] * w_u + s[col.CONIC_B] * w_v
    v_mv = s[col.CONIC_B] * w_u + s[col.CONIC_C] * w_v
    return n_u * w_u + n_v * w_v, v_mu, v_mv


@kernel_part
def _rotation_column_vjp(cam, lens, v_mu, v_mv, scale):
    """From a column of M to that column of R_q."""
    a, b, tx, ty = lens
    v_x = a * v_mu * scale
    v_y = b * v_mv * scale
    v_z = -(tx * v_x + ty * v_y)
    return (
        cam[col.R00] * v_x + cam[col.R10] * v_y + cam[col.R20] * v_z,
        cam[col.R01] * v_x + cam[col.R11] * v_y + cam[col.R21] * v_z,
        cam[col.R02] * v_x + cam[col.R12] * v_y + cam[col.R22] * v_z,
    )


@kernel_part
def _quaternion_vjp(quat, norm, v_R, v_quat):
    """From R, row by row, to the unit quaternion, then through its normalisation."""
    g00, g01, g02, g10, g11, g12, g20, g21, g22 = v_R
    qw = quat[0] / norm
    qx = quat[1] / norm
    qy = quat[2] / norm
    qz = quat[3] / norm
    v_w = _TWO * (qx * (g21 - g12) + qy * (g02 - g20) + qz * (g10 - g01))
    v_x = _TWO * (qy * (g01 + g10) + qz * (g02 + g20) + qw * (g21 - g12) - _TWO * qx * (g11 + g22))
    v_y = _TWO * (qx * (g01 + g10) + qz * (g12 + g21) + qw * (g02 - g20) - _TWO * qy * (g00 + g22))
    v_z = _TWO * (qx * (g02 + g20) + qy * (g12 + g21) + qw * (g10 - g01) - _TWO * qz * (g00 + g11))
    radial = qw * v_w + qx * v_x + qy * v_y + qz * v_z
    v_quat[0] = (v_w - qw * radial) / norm
    v_quat[1] = (v_x - qx * radial) / norm
    v_quat[2] = (v_y - qy * radial) / norm
    v_quat[3] = (v_z - qz * radial) / norm


@kernel_part
def _colour_vjp(cam, s, total, xyz, sh, scratch, v_xyz, v_sh):
    """From the colour of a splat to its coefficients and, through the direction of view, added to
    its position."""
    basis, w = scratch
    K = sh.shape[0]
    v_red = total[pair.SUM_RED] if s[col.RED] > _ZERO else _ZERO
    v_green = total[pair.SUM_GREEN] if s[col.GREEN] > _ZERO else _ZERO
    v_blue = total[pair.SUM_BLUE] if s[col.BLUE] > _ZERO else _ZERO
    dx, dy, dz, inv = direction(cam, xyz[0], xyz[1], xyz[2])
    basis_into(dx, dy, dz, K, basis)
    for k in range(K):
        v_sh[k, 0] = basis[k] * v_red
        v_sh[k, 1] = basis[k] * v_green
        v_sh[k, 2] = basis[k] * v_blue
        w[k] = sh[k, 0] * v_red + sh[k, 1] * v_green + sh[k, 2] * v_blue
    if K > 1:
        e0, e1, e2 = gradient_into(dx, dy, dz, K, w)
        radial = dx * e0 + dy * e1 + dz * e2
        v_xyz[0] += (e0 - dx * radial) * inv
        v_xyz[1] += (e1 - dy * radial) * inv
        v_xyz[2] += (e2 - dz * radial) * inv
