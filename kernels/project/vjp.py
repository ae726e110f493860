"""The gradient of projection and colour with respect to every parameter, in one pass over the rows (numba)."""

import math

import numpy as np
from numba import njit, prange

from ..composite.layout import (
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
from ..runtime.numba.scalars import cyclic_size, cyclic_task
from .geometry import camera_point, clamp, direction, rotation
from .layout import (
    BLUE,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    DEPTH,
    FX,
    FY,
    GREEN,
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
)
from .numba import CHUNK

f32 = np.float32
_HALF, _ONE, _TWO, _ZERO = f32(0.5), f32(1.0), f32(2.0), f32(0.0)


@njit(parallel=True, cache=True, error_model="numpy")
def project_rows_vjp(params, cam, splats, start, trained, pair_sums, v_params):
    """Add up each row's pair sums and carry them to its parameters; every row of the outputs is written.

    Rows that are not ``trained`` get zero and their pair sums are not read; an empty array stands for all rows.
    """
    xyz, log_scale, quat, sh = params.xyz, params.log_scale, params.quat, params.sh
    v_xyz, v_log_scale, v_quat = v_params.xyz, v_params.log_scale, v_params.quat
    v_logit, v_sh = v_params.logit, v_params.sh
    all_trained = trained.shape[0] == 0
    N = sh.shape[0]
    n_parts = (N + CHUNK - 1) // CHUNK
    for k_part in prange(cyclic_size(n_parts)):
        part = cyclic_task(k_part, n_parts)
        if part >= n_parts:
            continue
        total = np.empty(PAIR_SUMS, np.float32)
        basis, w = np.empty(16, np.float32), np.empty(16, np.float32)
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
            v_logit[i] = total[SUM_G] * (_ONE - math.exp(s[LN_OPACITY]))
            _project_vjp(cam, s, total, (xyz[i], log_scale[i], quat[i]), v_xyz[i], v_log_scale[i], v_quat[i])
            _colour_vjp(cam, s, total, xyz[i], sh[i], (basis, w), v_xyz[i], v_sh[i])


@njit(inline="always")
def _project_vjp(cam, s, total, row, v_xyz, v_log_scale, v_quat):
    """From the centre, the conic and the depth of a splat to its row: position, log scales, quaternion."""
    xyz, log_scale, quat = row
    v_u, v_v, v_uu, v_uv, v_vv = _covariance_vjp(s, total)
    x, y, _ = camera_point(cam, xyz[0], xyz[1], xyz[2])
    inv_z = _ONE / s[DEPTH]
    x_z, y_z = x * inv_z, y * inv_z
    tx, ty = clamp(x_z, cam[LIMIT_X]), clamp(y_z, cam[LIMIT_Y])
    norm, r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation(quat)
    frame = (cam[FX] * inv_z, cam[FY] * inv_z, tx, ty, v_uu, v_uv, v_vv)
    g00, g10, g20, l0, tx0, ty0, mm0 = _column_vjp(cam, frame, r00, r10, r20, math.exp(log_scale[0]))
    g01, g11, g21, l1, tx1, ty1, mm1 = _column_vjp(cam, frame, r01, r11, r21, math.exp(log_scale[1]))
    g02, g12, g22, l2, tx2, ty2, mm2 = _column_vjp(cam, frame, r02, r12, r22, math.exp(log_scale[2]))
    v_log_scale[0], v_log_scale[1], v_log_scale[2] = l0, l1, l2
    v_tx, v_ty, v_mm = tx0 + tx1 + tx2, ty0 + ty1 + ty2, mm0 + mm1 + mm2
    _quaternion_vjp(quat, norm, (g00, g01, g02, g10, g11, g12, g20, g21, g22), v_quat)
    v_xz = cam[FX] * v_u + (v_tx if tx == x_z else _ZERO)
    v_yz = cam[FY] * v_v + (v_ty if ty == y_z else _ZERO)
    c0, c1 = v_xz * inv_z, v_yz * inv_z
    c2 = total[SUM_DEPTH] - inv_z * (x_z * v_xz + y_z * v_yz + v_mm)
    v_xyz[0] = cam[R00] * c0 + cam[R10] * c1 + cam[R20] * c2
    v_xyz[1] = cam[R01] * c0 + cam[R11] * c1 + cam[R21] * c2
    v_xyz[2] = cam[R02] * c0 + cam[R12] * c1 + cam[R22] * c2


@njit(inline="always")
def _covariance_vjp(s, total):
    """dL/d of the centre u, v and of the 2D covariance uu, uv, vv, from the sums over a splat's pixels."""
    A, B, C = s[CONIC_A], s[CONIC_B], s[CONIC_C]
    # ln alpha = ln o - (A dx^2 + C dy^2) / 2 - B dx dy,  d = pixel - centre
    v_u, v_v = A * total[SUM_GX] + B * total[SUM_GY], B * total[SUM_GX] + C * total[SUM_GY]
    v_A, v_B, v_C = -_HALF * total[SUM_GXX], -_HALF * total[SUM_GXY], -_HALF * total[SUM_GYY]
    # v_cov = -Q v_Q Q
    p00, p01 = v_A * A + v_B * B, v_A * B + v_B * C
    p10, p11 = v_B * A + v_C * B, v_B * B + v_C * C
    return v_u, v_v, -(A * p00 + B * p10), -_TWO * (A * p01 + B * p11), -(B * p01 + C * p11)


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


@njit(inline="always")
def _quaternion_vjp(quat, norm, v_R, v_quat):
    """From R, row by row, to the unit quaternion, then through its normalisation."""
    g00, g01, g02, g10, g11, g12, g20, g21, g22 = v_R
    qw, qx, qy, qz = quat[0] / norm, quat[1] / norm, quat[2] / norm, quat[3] / norm
    v_w = _TWO * (qx * (g21 - g12) + qy * (g02 - g20) + qz * (g10 - g01))
    v_x = _TWO * (qy * (g01 + g10) + qz * (g02 + g20) + qw * (g21 - g12) - _TWO * qx * (g11 + g22))
    v_y = _TWO * (qx * (g01 + g10) + qz * (g12 + g21) + qw * (g02 - g20) - _TWO * qy * (g00 + g22))
    v_z = _TWO * (qx * (g02 + g20) + qy * (g12 + g21) + qw * (g10 - g01) - _TWO * qz * (g00 + g11))
    along = qw * v_w + qx * v_x + qy * v_y + qz * v_z
    v_quat[0], v_quat[1] = (v_w - qw * along) / norm, (v_x - qx * along) / norm
    v_quat[2], v_quat[3] = (v_y - qy * along) / norm, (v_z - qz * along) / norm


@njit(inline="always")
def _colour_vjp(cam, s, total, xyz, sh, scratch, v_xyz, v_sh):
    """From the colour of a splat to its coefficients and, through the direction of view, added to its position."""
    basis, w = scratch
    K = sh.shape[0]
    v_red = total[SUM_RED] if s[RED] > _ZERO else _ZERO
    v_green = total[SUM_GREEN] if s[GREEN] > _ZERO else _ZERO
    v_blue = total[SUM_BLUE] if s[BLUE] > _ZERO else _ZERO
    dx, dy, dz, inv = direction(cam, xyz[0], xyz[1], xyz[2])
    basis_into(dx, dy, dz, K, basis)
    for k in range(K):
        v_sh[k, 0], v_sh[k, 1], v_sh[k, 2] = basis[k] * v_red, basis[k] * v_green, basis[k] * v_blue
        w[k] = sh[k, 0] * v_red + sh[k, 1] * v_green + sh[k, 2] * v_blue
    if K > 1:
        e0, e1, e2 = gradient_into(dx, dy, dz, K, w)
        radial = dx * e0 + dy * e1 + dz * e2
        v_xyz[0] += (e0 - dx * radial) * inv
        v_xyz[1] += (e1 - dy * radial) * inv
        v_xyz[2] += (e2 - dz * radial) * inv
