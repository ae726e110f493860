"""Projection and colour of every Gaussian, and their gradient, each in one pass over the rows.

Formulas and names are those of ``render.project`` and ``geometry.spherical_harmonics`` of gsfusion_nb, unrolled so that
a row is read once and its intermediate values stay in registers. The pose is inverted in the kernel: it may have just
been computed on the device, and nothing waits for it.
"""

# Triton's functions are called with tensors for what their signatures call constants:
# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportIndexIssue=false
# pyright: reportGeneralTypeIssues=false

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsfusion_nb.constants import ALPHA_MIN, NEAR_PLANE_M, SCREEN_BLUR_PX2
from gsfusion_nb.types import Camera, GaussianParams

from ..harmonics.triton import harmonic, harmonic_gradient
from ..runtime.triton.launch import launch, parts
from .lens import lens

SPLAT = 12
"""u, v, conic A, B, C, ln(opacity), r, g, b, depth, half extents x, y of the ellipse alpha >= 1/255; of gradients the
last two are not used."""

_BLOCK = 128
_NEAR = tl.constexpr(NEAR_PLANE_M)
_BLUR = tl.constexpr(SCREEN_BLUR_PX2)
_BLUR2 = tl.constexpr(SCREEN_BLUR_PX2**2)
_ALPHA_MIN = tl.constexpr(ALPHA_MIN)
_LOG_ALPHA_MIN = tl.constexpr(math.log(ALPHA_MIN))


def project_rows(params: GaussianParams, camera: Camera, T_WC: Tensor) -> tuple[Tensor, Tensor]:
    """Splats [N, SPLAT] and their depths [N], infinite for those that are not drawn. T_WC: float32 [4, 4]."""
    N, device = len(params), T_WC.device
    splats = torch.empty(N, SPLAT, dtype=torch.float32, device=device)
    depth = torch.empty(N, dtype=torch.float32, device=device)
    arrays = (params.xyz_W, params.log_scale, params.quat, params.opacity_logit, params.sh)
    launch(
        _project, parts(N, _BLOCK), device, *(a.detach().contiguous() for a in arrays), T_WC, splats, depth, N,
        *lens(camera), camera.width, camera.height, K=params.sh.shape[1], BLOCK=_BLOCK, num_warps=4,
    )  # fmt: skip
    return splats, depth


def project_rows_vjp(
    params: GaussianParams, camera: Camera, T_WC: Tensor, splats: Tensor, v_splats: Tensor, rows: Tensor | None
) -> GaussianParams:
    """Gradients of the parameters from those of the splats [N, SPLAT]; zero where ``rows`` [N] is false."""
    N, device = len(params), T_WC.device
    arrays = [params.xyz_W, params.log_scale, params.quat, params.opacity_logit, params.sh]
    out = [torch.empty_like(a, memory_format=torch.contiguous_format) for a in arrays]
    trained = splats if rows is None else rows.contiguous().view(torch.uint8)
    launch(
        _project_vjp, parts(N, _BLOCK), device, *(a.detach().contiguous() for a in arrays), T_WC, splats, v_splats,
        trained, *out, N, *lens(camera), K=params.sh.shape[1], SOME=rows is not None, BLOCK=_BLOCK, num_warps=4,
    )  # fmt: skip
    names = ("xyz_W", "log_scale", "quat", "opacity_logit", "sh")
    return GaussianParams(**dict(zip(names, out, strict=True)))


@triton.jit
def rotation(w, x, y, z):
    """|q|, and the entries of R(q / |q|) row by row."""
    norm = tl.maximum(tl.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    return (
        norm,
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@triton.jit
def load3(base, row, mask):
    """Three consecutive numbers of each row."""
    return (
        tl.load(base + 3 * row, mask=mask, other=0.0),
        tl.load(base + 3 * row + 1, mask=mask, other=0.0),
        tl.load(base + 3 * row + 2, mask=mask, other=0.0),
    )


@triton.jit
def load4(base, row, mask):
    """A quaternion of each row; the identity where the mask is false."""
    return (
        tl.load(base + 4 * row, mask=mask, other=1.0),
        tl.load(base + 4 * row + 1, mask=mask, other=0.0),
        tl.load(base + 4 * row + 2, mask=mask, other=0.0),
        tl.load(base + 4 * row + 3, mask=mask, other=0.0),
    )


@triton.jit
def load_rotation(T):
    """R_WC of a pose, row by row."""
    return (
        tl.load(T), tl.load(T + 1), tl.load(T + 2), tl.load(T + 4), tl.load(T + 5), tl.load(T + 6),
        tl.load(T + 8), tl.load(T + 9), tl.load(T + 10),
    )  # fmt: skip


@triton.jit
def _turned(T, q0, q1, q2, q3):
    """|q|, and R_CW R_q row by row."""
    c0, c3, c6, c1, c4, c7, c2, c5, c8 = load_rotation(T)  # transposed: c are the rows of R_CW
    norm, r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation(q0, q1, q2, q3)
    return (
        norm,
        c0 * r0 + c1 * r3 + c2 * r6, c0 * r1 + c1 * r4 + c2 * r7, c0 * r2 + c1 * r5 + c2 * r8,
        c3 * r0 + c4 * r3 + c5 * r6, c3 * r1 + c4 * r4 + c5 * r7, c3 * r2 + c4 * r5 + c5 * r8,
        c6 * r0 + c7 * r3 + c8 * r6, c6 * r1 + c7 * r4 + c8 * r7, c6 * r2 + c7 * r5 + c8 * r8,
    )  # fmt: skip


@triton.jit
def _in_camera(T, X, Y, Z):
    """Points in the camera frame; also the offsets from its centre, world frame."""
    c0, c3, c6, c1, c4, c7, c2, c5, c8 = load_rotation(T)
    X, Y, Z = X - tl.load(T + 3), Y - tl.load(T + 7), Z - tl.load(T + 11)
    return X, Y, Z, c0 * X + c1 * Y + c2 * Z, c3 * X + c4 * Y + c5 * Z, c6 * X + c7 * Y + c8 * Z


@triton.jit(do_not_specialize=["N", "width", "height"])
def _project(
    xyz, log_scale, quat, logit, sh, T, splats, depth, N, fx, fy, cx, cy, limit_x, limit_y, width, height,
    K: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row = i < N
    X, Y, Z = load3(xyz, i, row)
    X, Y, Z, x, y, z = _in_camera(T, X, Y, Z)
    in_front = z > _NEAR
    inv_z = 1.0 / tl.where(in_front, z, 1.0)
    x_z, y_z = x * inv_z, y * inv_z
    tx = tl.minimum(tl.maximum(x_z, -limit_x), limit_x)
    ty = tl.minimum(tl.maximum(y_z, -limit_y), limit_y)
    s0, s1, s2 = load3(log_scale, i, row)
    s0, s1, s2 = tl.exp(s0), tl.exp(s1), tl.exp(s2)
    q0, q1, q2, q3 = load4(quat, i, row)
    _, b00, b01, b02, b10, b11, b12, b20, b21, b22 = _turned(T, q0, q1, q2, q3)
    a, b = fx * inv_z, fy * inv_z
    mu0, mu1, mu2 = a * (b00 - tx * b20) * s0, a * (b01 - tx * b21) * s1, a * (b02 - tx * b22) * s2
    mv0, mv1, mv2 = b * (b10 - ty * b20) * s0, b * (b11 - ty * b21) * s1, b * (b12 - ty * b22) * s2
    uu, vv = mu0 * mu0 + mu1 * mu1 + mu2 * mu2, mv0 * mv0 + mv1 * mv1 + mv2 * mv2
    uv = mu0 * mv0 + mu1 * mv1 + mu2 * mv2
    c0, c1, c2 = mu1 * mv2 - mu2 * mv1, mu2 * mv0 - mu0 * mv2, mu0 * mv1 - mu1 * mv0
    inv_det = 1.0 / (c0 * c0 + c1 * c1 + c2 * c2 + _BLUR * (uu + vv) + _BLUR2)
    opacity = 1.0 / (1.0 + tl.exp(-tl.load(logit + i, mask=row, other=0.0)))
    ln_o = tl.log(tl.maximum(opacity, 1e-30))
    reach = 2.0 * tl.maximum(ln_o - _LOG_ALPHA_MIN, 0.0)
    u, v = fx * x_z + cx, fy * y_z + cy
    e_u, e_v = tl.sqrt(reach * (uu + _BLUR)), tl.sqrt(reach * (vv + _BLUR))
    drawn = in_front & (opacity >= _ALPHA_MIN)
    drawn = drawn & (u + e_u > 0) & (u - e_u < width) & (v + e_v > 0) & (v - e_v < height)
    tl.store(depth + i, tl.where(drawn, z, float("inf")), mask=row)

    distance = tl.maximum(tl.sqrt(X * X + Y * Y + Z * Z), 1e-12)
    X, Y, Z = X / distance, Y / distance, Z / distance
    red, green, blue = 0.5 + 0.0 * X, 0.5 + 0.0 * X, 0.5 + 0.0 * X
    for k in tl.static_range(K):
        basis = harmonic(k, X, Y, Z)
        h0, h1, h2 = load3(sh, i * K + k, row & drawn)
        red, green, blue = red + basis * h0, green + basis * h1, blue + basis * h2

    s = splats + i * 12
    tl.store(s, u, mask=row)
    tl.store(s + 1, v, mask=row)
    tl.store(s + 2, (vv + _BLUR) * inv_det, mask=row)
    tl.store(s + 3, -uv * inv_det, mask=row)
    tl.store(s + 4, (uu + _BLUR) * inv_det, mask=row)
    tl.store(s + 5, ln_o, mask=row)
    tl.store(s + 6, tl.maximum(red, 0.0), mask=row)
    tl.store(s + 7, tl.maximum(green, 0.0), mask=row)
    tl.store(s + 8, tl.maximum(blue, 0.0), mask=row)
    tl.store(s + 9, z, mask=row)
    tl.store(s + 10, e_u, mask=row)
    tl.store(s + 11, e_v, mask=row)


@triton.jit
def _inverse_vjp(A, B, C, v_A, v_B, v_C):
    """Gradient of Q = cov^-1: v_cov = -Q v_Q Q, where the off-diagonal number stands for two entries."""
    v_B = 0.5 * v_B
    p00, p01 = v_A * A + v_B * B, v_A * B + v_B * C
    p10, p11 = v_B * A + v_C * B, v_B * B + v_C * C
    return -(A * p00 + B * p10), -2 * (A * p01 + B * p11), -(B * p01 + C * p11)


@triton.jit(do_not_specialize=["N"])
def _project_vjp(
    xyz, log_scale, quat, logit, sh, T, splats, v_splats, trained, o_xyz, o_log_scale, o_quat, o_logit, o_sh, N,
    fx, fy, cx, cy, limit_x, limit_y, K: tl.constexpr, SOME: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row = i < N
    X, Y, Z = load3(xyz, i, row)
    X, Y, Z, x, y, z = _in_camera(T, X, Y, Z)
    live = row & (z > _NEAR)
    if SOME:
        live = live & (tl.load(trained + i, mask=row, other=0) != 0)
    inv_z = 1.0 / tl.where(z > _NEAR, z, 1.0)
    x_z, y_z = x * inv_z, y * inv_z
    tx = tl.minimum(tl.maximum(x_z, -limit_x), limit_x)
    ty = tl.minimum(tl.maximum(y_z, -limit_y), limit_y)
    s0, s1, s2 = load3(log_scale, i, row)
    s0, s1, s2 = tl.exp(s0), tl.exp(s1), tl.exp(s2)
    q0, q1, q2, q3 = load4(quat, i, row)
    norm, b00, b01, b02, b10, b11, b12, b20, b21, b22 = _turned(T, q0, q1, q2, q3)
    b00, b10, b20, b01, b11, b21 = b00 * s0, b10 * s0, b20 * s0, b01 * s1, b11 * s1, b21 * s1
    b02, b12, b22 = b02 * s2, b12 * s2, b22 * s2
    a, b = fx * inv_z, fy * inv_z
    mu0, mu1, mu2 = a * (b00 - tx * b20), a * (b01 - tx * b21), a * (b02 - tx * b22)
    mv0, mv1, mv2 = b * (b10 - ty * b20), b * (b11 - ty * b21), b * (b12 - ty * b22)

    s, g = splats + i * 12, v_splats + i * 12
    A, B, C = (
        tl.load(s + 2, mask=live, other=0.0),
        tl.load(s + 3, mask=live, other=0.0),
        tl.load(s + 4, mask=live, other=0.0),
    )
    v_u, v_v = tl.load(g, mask=live, other=0.0), tl.load(g + 1, mask=live, other=0.0)
    v_uu, v_uv, v_vv = _inverse_vjp(
        A, B, C, tl.load(g + 2, mask=live, other=0.0), tl.load(g + 3, mask=live, other=0.0),
        tl.load(g + 4, mask=live, other=0.0),
    )  # fmt: skip
    v_mu0, v_mu1, v_mu2 = 2 * v_uu * mu0 + v_uv * mv0, 2 * v_uu * mu1 + v_uv * mv1, 2 * v_uu * mu2 + v_uv * mv2
    v_mv0, v_mv1, v_mv2 = 2 * v_vv * mv0 + v_uv * mu0, 2 * v_vv * mv1 + v_uv * mu1, 2 * v_vv * mv2 + v_uv * mu2
    w00, w01, w02 = a * v_mu0, a * v_mu1, a * v_mu2  # v_B, row by row
    w10, w11, w12 = b * v_mv0, b * v_mv1, b * v_mv2
    w20, w21, w22 = -(tx * w00 + ty * w10), -(tx * w01 + ty * w11), -(tx * w02 + ty * w12)
    v_tx = -(b20 * w00 + b21 * w01 + b22 * w02)
    v_ty = -(b20 * w10 + b21 * w11 + b22 * w12)
    v_xz = fx * v_u + tl.where(tx == x_z, v_tx, 0.0)
    v_yz = fy * v_v + tl.where(ty == y_z, v_ty, 0.0)
    v_x, v_y = v_xz * inv_z, v_yz * inv_z
    along = mu0 * v_mu0 + mu1 * v_mu1 + mu2 * v_mu2 + mv0 * v_mv0 + mv1 * v_mv1 + mv2 * v_mv2
    v_z = tl.load(g + 9, mask=live, other=0.0) - inv_z * (x_z * v_xz + y_z * v_yz + along)
    k0, k1, k2, k3, k4, k5, k6, k7, k8 = load_rotation(T)  # R_WC
    v_X, v_Y, v_Z = k0 * v_x + k1 * v_y + k2 * v_z, k3 * v_x + k4 * v_y + k5 * v_z, k6 * v_x + k7 * v_y + k8 * v_z

    tl.store(o_log_scale + 3 * i, w00 * b00 + w10 * b10 + w20 * b20, mask=row)
    tl.store(o_log_scale + 3 * i + 1, w01 * b01 + w11 * b11 + w21 * b21, mask=row)
    tl.store(o_log_scale + 3 * i + 2, w02 * b02 + w12 * b12 + w22 * b22, mask=row)
    # v of R_q: R_WC v_B, column k times s_k
    m00, m10, m20 = (
        (k0 * w00 + k1 * w10 + k2 * w20) * s0,
        (k3 * w00 + k4 * w10 + k5 * w20) * s0,
        (k6 * w00 + k7 * w10 + k8 * w20) * s0,
    )
    m01, m11, m21 = (
        (k0 * w01 + k1 * w11 + k2 * w21) * s1,
        (k3 * w01 + k4 * w11 + k5 * w21) * s1,
        (k6 * w01 + k7 * w11 + k8 * w21) * s1,
    )
    m02, m12, m22 = (
        (k0 * w02 + k1 * w12 + k2 * w22) * s2,
        (k3 * w02 + k4 * w12 + k5 * w22) * s2,
        (k6 * w02 + k7 * w12 + k8 * w22) * s2,
    )
    q0, q1, q2, q3 = q0 / norm, q1 / norm, q2 / norm, q3 / norm
    e0 = 2 * (q1 * (m21 - m12) + q2 * (m02 - m20) + q3 * (m10 - m01))
    e1 = 2 * (q2 * (m01 + m10) + q3 * (m02 + m20) + q0 * (m21 - m12) - 2 * q1 * (m11 + m22))
    e2 = 2 * (q1 * (m01 + m10) + q3 * (m12 + m21) + q0 * (m02 - m20) - 2 * q2 * (m00 + m22))
    e3 = 2 * (q1 * (m02 + m20) + q2 * (m12 + m21) + q0 * (m10 - m01) - 2 * q3 * (m00 + m11))
    along = q0 * e0 + q1 * e1 + q2 * e2 + q3 * e3
    tl.store(o_quat + 4 * i, (e0 - q0 * along) / norm, mask=row)
    tl.store(o_quat + 4 * i + 1, (e1 - q1 * along) / norm, mask=row)
    tl.store(o_quat + 4 * i + 2, (e2 - q2 * along) / norm, mask=row)
    tl.store(o_quat + 4 * i + 3, (e3 - q3 * along) / norm, mask=row)
    opacity = 1.0 / (1.0 + tl.exp(-tl.load(logit + i, mask=row, other=0.0)))
    tl.store(o_logit + i, tl.load(g + 5, mask=live, other=0.0) * (1.0 - opacity), mask=row)

    distance = tl.maximum(tl.sqrt(X * X + Y * Y + Z * Z), 1e-12)
    X, Y, Z = X / distance, Y / distance, Z / distance
    # a colour that is not clamped is above zero; at zero exactly the reference lets the gradient through
    v_r = tl.where(tl.load(s + 6, mask=live, other=0.0) > 0, tl.load(g + 6, mask=live, other=0.0), 0.0)
    v_g = tl.where(tl.load(s + 7, mask=live, other=0.0) > 0, tl.load(g + 7, mask=live, other=0.0), 0.0)
    v_b = tl.where(tl.load(s + 8, mask=live, other=0.0) > 0, tl.load(g + 8, mask=live, other=0.0), 0.0)
    d0, d1, d2 = 0.0 * X, 0.0 * X, 0.0 * X
    for k in tl.static_range(K):
        basis = harmonic(k, X, Y, Z)
        if K > 1:
            h0, h1, h2 = load3(sh, i * K + k, live)
            weight = h0 * v_r + h1 * v_g + h2 * v_b
            g0, g1, g2 = harmonic_gradient(k, X, Y, Z)
            d0, d1, d2 = d0 + weight * g0, d1 + weight * g1, d2 + weight * g2
        tl.store(o_sh + 3 * (i * K + k), basis * v_r, mask=row)
        tl.store(o_sh + 3 * (i * K + k) + 1, basis * v_g, mask=row)
        tl.store(o_sh + 3 * (i * K + k) + 2, basis * v_b, mask=row)
    along = X * d0 + Y * d1 + Z * d2
    tl.store(o_xyz + 3 * i, v_X + (d0 - X * along) / distance, mask=row)
    tl.store(o_xyz + 3 * i + 1, v_Y + (d1 - Y * along) / distance, mask=row)
    tl.store(o_xyz + 3 * i + 2, v_Z + (d2 - Z * along) / distance, mask=row)
