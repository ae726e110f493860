"""The gradient of ``project_rows``, in one pass over the rows; names as there."""

import math
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.render.constants import SCREEN_BLUR_PX2
from gsfusion_nb.types import GaussianParams

from ..composite import layout as pair
from ..harmonics.numba import basis_into, gradient_into
from ..runtime.numba.scalars import cyclic_size, cyclic_task, kernel_part
from . import layout as col
from .layout import arrays_of
from .numba import CHUNK, camera_point, clamp, direction, rotation

f32 = np.float32
_BLUR = f32(SCREEN_BLUR_PX2)
_HALF = f32(0.5)
_ONE = f32(1.0)
_TWO = f32(2.0)
_ZERO = f32(0.0)


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
