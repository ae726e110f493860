"""Projection, colour and tile test of every Gaussian, and their gradient, each in one pass over the rows.

Formulas and names are those of ``render.project`` and ``geometry.spherical_harmonics`` of gsfusion_nb, unrolled to
scalars here, so that a row is read once and its intermediate values stay in registers.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from gsfusion_nb.constants import ALPHA_MIN, FARTHEST_PX, NEAR_PLANE_M, SCREEN_BLUR_PX2

from ..binning.tile_windows import FIRST_X, FIRST_Y, LAST_X, LAST_Y
from ..composite.numba import TILE
from ..composite.sums import (
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
from ..harmonics.numba import basis_into, gradient_into
from ..runtime.numba.cyclic import cyclic_size, cyclic_task
from .lens import projection_lens
from .splat import (
    BLUE,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    DEPTH,
    EXTENT_U,
    EXTENT_V,
    GREEN,
    LN_OPACITY,
    RED,
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

R00, R01, R02, R10, R11, R12, R20, R21, R22, T0, T1, T2 = range(12)
CENTRE_X, CENTRE_Y, CENTRE_Z, FX, FY, CX, CY, LIMIT_X, LIMIT_Y, WIDTH, HEIGHT = range(12, 23)
"""The camera as 23 float32: R_CW, t_CW, its centre, fx, fy, cx, cy, limits of x/z and y/z in J, image size."""


class Params(NamedTuple):
    """The parameters of a map, or dL/d of each, one Gaussian a row. float32"""

    xyz: np.ndarray
    log_scale: np.ndarray
    quat: np.ndarray
    logit: np.ndarray
    sh: np.ndarray


def pack_camera(camera, T_CW: np.ndarray, centre_W: np.ndarray) -> np.ndarray:
    """The camera and its pose as one float32 array, in the order of the constants above."""
    tail = [*projection_lens(camera), camera.width, camera.height]
    return np.concatenate([T_CW[:3, :3].ravel(), T_CW[:3, 3], centre_W, tail]).astype(np.float32)


@njit(inline="always")
def _rotation(q):
    """|q| and the entries of R(q / |q|), row by row."""
    norm = max(math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), f32(1e-12))
    w, x, y, z = q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm
    return (
        norm,
        _ONE - _TWO * (y * y + z * z), _TWO * (x * y - w * z), _TWO * (x * z + w * y),
        _TWO * (x * y + w * z), _ONE - _TWO * (x * x + z * z), _TWO * (y * z - w * x),
        _TWO * (x * z - w * y), _TWO * (y * z + w * x), _ONE - _TWO * (x * x + y * y),
    )  # fmt: skip


@njit(inline="always")
def _clamp(x, limit):
    return min(max(x, -limit), limit)


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
        z = cam[R20] * X + cam[R21] * Y + cam[R22] * Z + cam[T2]
        inv_z = _ONE / max(z, _NEAR)
        x = (cam[R00] * X + cam[R01] * Y + cam[R02] * Z + cam[T0]) * inv_z
        y = (cam[R10] * X + cam[R11] * Y + cam[R12] * Z + cam[T1]) * inv_z
        tx, ty = _clamp(x, cam[LIMIT_X]), _clamp(y, cam[LIMIT_Y])
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


@njit(parallel=True, cache=True, error_model="numpy")
def project_rows(params, cam, wanted, splats, count, noted):
    """Fill ``splats`` [N, SPLAT] and ``count`` [N], the number of tiles each is listed in (0: not drawn).

    wanted: ``TileWindows``, where there are pixels to be drawn.
    noted: for each chunk ``NOTED_PER_CHUNK`` numbers, the tiles of its rows one after another, as far as they fit.
    """
    xyz, log_scale, quat, logit, sh = params.xyz, params.log_scale, params.quat, params.logit, params.sh
    windows, sums = wanted.windows, wanted.sums
    N, K = sh.shape[0], sh.shape[1]
    fx, fy = cam[FX], cam[FY]
    width, height = int(cam[WIDTH]), int(cam[HEIGHT])
    n_parts = (N + CHUNK - 1) // CHUNK
    for k_part in prange(cyclic_size(n_parts)):
        part = cyclic_task(k_part, n_parts)
        if part >= n_parts:
            continue
        Y = np.empty(16, np.float32)
        first, end = part * CHUNK, min(N, part * CHUNK + CHUNK)
        count[first:end] = 0
        candidates = np.empty(CHUNK, np.int32)
        n_noted = 0
        for j in range(_find_candidates(xyz, log_scale, cam, sums, first, end, candidates)):
            i = candidates[j]
            X, Yw, Z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            z = cam[R20] * X + cam[R21] * Yw + cam[R22] * Z + cam[T2]
            opacity = _ONE / (_ONE + math.exp(-logit[i]))
            if not (z > _NEAR and opacity >= _ALPHA_MIN):
                continue
            x = cam[R00] * X + cam[R01] * Yw + cam[R02] * Z + cam[T0]
            y = cam[R10] * X + cam[R11] * Yw + cam[R12] * Z + cam[T1]
            inv_z = _ONE / z
            u, v = fx * x * inv_z + cam[CX], fy * y * inv_z + cam[CY]
            tx, ty = _clamp(x * inv_z, cam[LIMIT_X]), _clamp(y * inv_z, cam[LIMIT_Y])
            a, b = fx * inv_z, fy * inv_z
            _, r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(quat[i])
            uu, vv, uv, cross2 = _ZERO, _ZERO, _ZERO, _ZERO
            s0, s1, s2 = math.exp(log_scale[i, 0]), math.exp(log_scale[i, 1]), math.exp(log_scale[i, 2])
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
            s = splats[i]
            s[U], s[V] = u, v
            s[CONIC_A], s[CONIC_B], s[CONIC_C] = (vv + _BLUR) * inv_det, -uv * inv_det, (uu + _BLUR) * inv_det
            s[LN_OPACITY] = math.log(opacity)
            reach = _TWO * (s[LN_OPACITY] - _LOG_ALPHA_MIN)
            s[DEPTH] = z
            s[EXTENT_U], s[EXTENT_V] = math.sqrt(reach * (uu + _BLUR)), math.sqrt(reach * (vv + _BLUR))
            small = s[EXTENT_U] < _FARTHEST and s[EXTENT_V] < _FARTHEST
            if not (abs(u) < _FARTHEST and abs(v) < _FARTHEST and small):
                continue
            count[i] = tiles_of(
                s, width, height, windows, noted, part * NOTED_PER_CHUNK + n_noted, NOTED_PER_CHUNK - n_noted
            )
            if count[i] == 0:
                continue
            dx, dy, dz = X - cam[CENTRE_X], Yw - cam[CENTRE_Y], Z - cam[CENTRE_Z]
            inv = _ONE / max(math.sqrt(dx * dx + dy * dy + dz * dz), f32(1e-12))
            basis_into(dx * inv, dy * inv, dz * inv, K, Y)
            red, green, blue = _HALF, _HALF, _HALF
            for k in range(K):
                red += Y[k] * sh[i, k, 0]
                green += Y[k] * sh[i, k, 1]
                blue += Y[k] * sh[i, k, 2]
            if not (abs(red) < _INFINITE and abs(green) < _INFINITE and abs(blue) < _INFINITE):
                count[i] = 0
                continue
            n_noted = min(n_noted + count[i], NOTED_PER_CHUNK)
            s[RED], s[GREEN], s[BLUE] = max(red, _ZERO), max(green, _ZERO), max(blue, _ZERO)


@njit(inline="always")
def _column_vjp(cam, frame, q0, q1, q2, scale):
    """One column of B = R_CW R_q S: the gradient to that column of R_q (3), its log scale, tx, ty, and m . v_m."""
    a, b, tx, ty, v_uu, v_uv, v_vv = frame
    B0 = (cam[R00] * q0 + cam[R01] * q1 + cam[R02] * q2) * scale
    B1 = (cam[R10] * q0 + cam[R11] * q1 + cam[R12] * q2) * scale
    B2 = (cam[R20] * q0 + cam[R21] * q1 + cam[R22] * q2) * scale
    m_u, m_v = a * (B0 - tx * B2), b * (B1 - ty * B2)
    v_mu = _TWO * v_uu * m_u + v_uv * m_v
    v_mv = _TWO * v_vv * m_v + v_uv * m_u
    v_B0, v_B1 = a * v_mu, b * v_mv
    v_B2 = -(tx * v_B0 + ty * v_B1)
    return (
        (cam[R00] * v_B0 + cam[R10] * v_B1 + cam[R20] * v_B2) * scale,
        (cam[R01] * v_B0 + cam[R11] * v_B1 + cam[R21] * v_B2) * scale,
        (cam[R02] * v_B0 + cam[R12] * v_B1 + cam[R22] * v_B2) * scale,
        v_B0 * B0 + v_B1 * B1 + v_B2 * B2,
        -a * B2 * v_mu,
        -b * B2 * v_mv,
        m_u * v_mu + m_v * v_mv,
    )


@njit(parallel=True, cache=True, error_model="numpy")
def project_rows_vjp(params, cam, splats, start, trained, pair_sums, v_params):
    """Add up each row's pair sums and carry them to its parameters; every row of the outputs is written.

    Rows that are not ``trained`` get zero and their pair sums are not read; an empty array stands for all rows.
    """
    xyz, log_scale, quat, sh = params.xyz, params.log_scale, params.quat, params.sh
    v_xyz, v_log_scale, v_quat = v_params.xyz, v_params.log_scale, v_params.quat
    v_logit, v_sh = v_params.logit, v_params.sh
    all_trained = trained.shape[0] == 0
    N, K = sh.shape[0], sh.shape[1]
    fx, fy = cam[FX], cam[FY]
    n_parts = (N + CHUNK - 1) // CHUNK
    for k_part in prange(cyclic_size(n_parts)):
        part = cyclic_task(k_part, n_parts)
        if part >= n_parts:
            continue
        total = np.empty(PAIR_SUMS, np.float32)
        Y = np.empty(16, np.float32)
        w = np.empty(16, np.float32)
        for i in range(part * CHUNK, min(N, part * CHUNK + CHUNK)):
            if start[i] == start[i + 1] or not (all_trained or trained[i]):
                v_xyz[i] = _ZERO
                v_log_scale[i] = _ZERO
                v_quat[i] = _ZERO
                v_logit[i] = _ZERO
                v_sh[i] = _ZERO
                continue
            total[:] = _ZERO
            for slot in range(start[i], start[i + 1]):
                for j in range(PAIR_SUMS):
                    total[j] += pair_sums[slot, j]
            s = splats[i]
            A, B, C = s[CONIC_A], s[CONIC_B], s[CONIC_C]
            # ln alpha = ln o - (A dx^2 + C dy^2) / 2 - B dx dy,  d = pixel - centre
            v_u, v_v = A * total[SUM_GX] + B * total[SUM_GY], B * total[SUM_GX] + C * total[SUM_GY]
            v_A, v_B, v_C = -_HALF * total[SUM_GXX], -_HALF * total[SUM_GXY], -_HALF * total[SUM_GYY]
            v_logit[i] = total[SUM_G] * (_ONE - math.exp(s[LN_OPACITY]))

            # v_cov = -Q v_Q Q
            p00, p01 = v_A * A + v_B * B, v_A * B + v_B * C
            p10, p11 = v_B * A + v_C * B, v_B * B + v_C * C
            v_uu, v_uv, v_vv = -(A * p00 + B * p10), -_TWO * (A * p01 + B * p11), -(B * p01 + C * p11)

            X, Yw, Z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            z = s[DEPTH]
            inv_z = _ONE / z
            x_z = (cam[R00] * X + cam[R01] * Yw + cam[R02] * Z + cam[T0]) * inv_z
            y_z = (cam[R10] * X + cam[R11] * Yw + cam[R12] * Z + cam[T1]) * inv_z
            tx, ty = _clamp(x_z, cam[LIMIT_X]), _clamp(y_z, cam[LIMIT_Y])
            a, b = fx * inv_z, fy * inv_z
            norm, r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(quat[i])
            frame = (a, b, tx, ty, v_uu, v_uv, v_vv)
            g00, g10, g20, l0, tx0, ty0, mm0 = _column_vjp(cam, frame, r00, r10, r20, math.exp(log_scale[i, 0]))
            g01, g11, g21, l1, tx1, ty1, mm1 = _column_vjp(cam, frame, r01, r11, r21, math.exp(log_scale[i, 1]))
            g02, g12, g22, l2, tx2, ty2, mm2 = _column_vjp(cam, frame, r02, r12, r22, math.exp(log_scale[i, 2]))
            v_log_scale[i, 0], v_log_scale[i, 1], v_log_scale[i, 2] = l0, l1, l2
            v_tx, v_ty, v_mm = tx0 + tx1 + tx2, ty0 + ty1 + ty2, mm0 + mm1 + mm2

            # quaternion: dR/dq of the unit quaternion, then through its normalisation
            qw, qx, qy, qz = quat[i, 0] / norm, quat[i, 1] / norm, quat[i, 2] / norm, quat[i, 3] / norm
            v_w = _TWO * (qx * (g21 - g12) + qy * (g02 - g20) + qz * (g10 - g01))
            v_x = _TWO * (qy * (g01 + g10) + qz * (g02 + g20) + qw * (g21 - g12) - _TWO * qx * (g11 + g22))
            v_y = _TWO * (qx * (g01 + g10) + qz * (g12 + g21) + qw * (g02 - g20) - _TWO * qy * (g00 + g22))
            v_z = _TWO * (qx * (g02 + g20) + qy * (g12 + g21) + qw * (g10 - g01) - _TWO * qz * (g00 + g11))
            along = qw * v_w + qx * v_x + qy * v_y + qz * v_z
            v_quat[i, 0], v_quat[i, 1] = (v_w - qw * along) / norm, (v_x - qx * along) / norm
            v_quat[i, 2], v_quat[i, 3] = (v_y - qy * along) / norm, (v_z - qz * along) / norm

            v_xz = fx * v_u + (v_tx if tx == x_z else _ZERO)
            v_yz = fy * v_v + (v_ty if ty == y_z else _ZERO)
            c0, c1 = v_xz * inv_z, v_yz * inv_z
            c2 = total[SUM_DEPTH] - inv_z * (x_z * v_xz + y_z * v_yz + v_mm)
            v_X = cam[R00] * c0 + cam[R10] * c1 + cam[R20] * c2
            v_Y = cam[R01] * c0 + cam[R11] * c1 + cam[R21] * c2
            v_Z = cam[R02] * c0 + cam[R12] * c1 + cam[R22] * c2

            # colour
            v_red = total[SUM_RED] if s[RED] > _ZERO else _ZERO
            v_green = total[SUM_GREEN] if s[GREEN] > _ZERO else _ZERO
            v_blue = total[SUM_BLUE] if s[BLUE] > _ZERO else _ZERO
            dx, dy, dz = X - cam[CENTRE_X], Yw - cam[CENTRE_Y], Z - cam[CENTRE_Z]
            inv = _ONE / max(math.sqrt(dx * dx + dy * dy + dz * dz), f32(1e-12))
            dx, dy, dz = dx * inv, dy * inv, dz * inv
            basis_into(dx, dy, dz, K, Y)
            for k in range(K):
                v_sh[i, k, 0], v_sh[i, k, 1], v_sh[i, k, 2] = Y[k] * v_red, Y[k] * v_green, Y[k] * v_blue
                w[k] = sh[i, k, 0] * v_red + sh[i, k, 1] * v_green + sh[i, k, 2] * v_blue
            if K > 1:
                e0, e1, e2 = gradient_into(dx, dy, dz, K, w)
                radial = dx * e0 + dy * e1 + dz * e2
                v_X += (e0 - dx * radial) * inv
                v_Y += (e1 - dy * radial) * inv
                v_Z += (e2 - dz * radial) * inv
            v_xyz[i, 0], v_xyz[i, 1], v_xyz[i, 2] = v_X, v_Y, v_Z
