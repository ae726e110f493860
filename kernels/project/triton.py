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

from gsfusion_nb.constants import ALPHA_MIN, FARTHEST_PX, NEAR_PLANE_M, SCREEN_BLUR_PX2
from gsfusion_nb.types import Camera, GaussianParams

from ..harmonics.triton import harmonic, harmonic_gradient
from ..runtime.triton.launch import launch, parts
from ..runtime.triton.vectors import load3, load4, load_position, load_rotation, rotation, store3, store4
from . import splat
from .lens import projection_lens

SPLAT = tl.constexpr(splat.SPLAT)
(U, V, CONIC_A, CONIC_B, CONIC_C, LN_OPACITY, RED, GREEN, BLUE, DEPTH, EXTENT_U, EXTENT_V) = (
    tl.constexpr(column) for column in splat.COLUMNS
)
"""Columns of a splat, see ``splat``, and of the gradients of splats, where the last two are not used."""

_NAMES = ("xyz_W", "log_scale", "quat", "opacity_logit", "sh")

_BLOCK = 128
_NEAR = tl.constexpr(NEAR_PLANE_M)
_BLUR = tl.constexpr(SCREEN_BLUR_PX2)
_BLUR2 = tl.constexpr(SCREEN_BLUR_PX2**2)
_FARTHEST = tl.constexpr(FARTHEST_PX)
_ALPHA_MIN = tl.constexpr(ALPHA_MIN)
_LOG_ALPHA_MIN = tl.constexpr(math.log(ALPHA_MIN))


def project_rows(params: GaussianParams, camera: Camera, T_WC: Tensor) -> tuple[Tensor, Tensor]:
    """Splats [N, SPLAT] and their depths [N], infinite for those that are not drawn. T_WC: float32 [4, 4]."""
    N, device = len(params), T_WC.device
    splats = torch.empty(N, splat.SPLAT, dtype=torch.float32, device=device)
    depth = torch.empty(N, dtype=torch.float32, device=device)
    launch(
        _project,
        parts(N, _BLOCK),
        device,
        **_arrays(params),
        T=T_WC,
        splats=splats,
        depth=depth,
        N=N,
        **projection_lens(camera)._asdict(),
        width=camera.width,
        height=camera.height,
        K=params.sh.shape[1],
        BLOCK=_BLOCK,
        num_warps=4,
    )
    return splats, depth


def project_rows_vjp(
    params: GaussianParams, camera: Camera, T_WC: Tensor, splats: Tensor, v_splats: Tensor, trained: Tensor | None
) -> GaussianParams:
    """Gradients of the parameters from those of the splats [N, SPLAT]; zero where ``trained``, uint8 [N], is 0."""
    N, device, arrays = len(params), T_WC.device, _arrays(params)
    out = {name: torch.empty_like(array) for name, array in arrays.items()}
    launch(
        _project_vjp,
        parts(N, _BLOCK),
        device,
        **arrays,
        T=T_WC,
        splats=splats,
        v_splats=v_splats,
        trained=splats if trained is None else trained,
        **{f"v_{name}": array for name, array in out.items()},
        N=N,
        **projection_lens(camera)._asdict(),
        K=params.sh.shape[1],
        SOME=trained is not None,
        BLOCK=_BLOCK,
        num_warps=4,
    )
    return GaussianParams(**out)


def _arrays(params: GaussianParams) -> dict[str, Tensor]:
    return {name: getattr(params, name).detach().contiguous() for name in _NAMES}


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
    C_x, C_y, C_z = load_position(T)
    X, Y, Z = X - C_x, Y - C_y, Z - C_z
    return X, Y, Z, c0 * X + c1 * Y + c2 * Z, c3 * X + c4 * Y + c5 * Z, c6 * X + c7 * Y + c8 * Z


@triton.jit(do_not_specialize=["N", "width", "height"])
def _project(
    xyz_W, log_scale, quat, opacity_logit, sh, T, splats, depth, N, fx, fy, cx, cy, limit_x, limit_y, width, height,
    K: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row = i < N
    X, Y, Z = load3(xyz_W, i, row)
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
    opacity = 1.0 / (1.0 + tl.exp(-tl.load(opacity_logit + i, mask=row, other=0.0)))
    ln_o = tl.log(tl.maximum(opacity, 1e-30))
    reach = 2.0 * tl.maximum(ln_o - _LOG_ALPHA_MIN, 0.0)
    u, v = fx * x_z + cx, fy * y_z + cy
    e_u, e_v = tl.sqrt(reach * (uu + _BLUR)), tl.sqrt(reach * (vv + _BLUR))
    drawn = row & in_front & (opacity >= _ALPHA_MIN)
    drawn = drawn & (tl.abs(u) < _FARTHEST) & (tl.abs(v) < _FARTHEST) & (e_u < _FARTHEST) & (e_v < _FARTHEST)
    drawn = drawn & (u + e_u > 0) & (u - e_u < width) & (v + e_v > 0) & (v - e_v < height)

    distance = tl.maximum(tl.sqrt(X * X + Y * Y + Z * Z), 1e-12)
    X, Y, Z = X / distance, Y / distance, Z / distance
    red, green, blue = 0.5 + 0.0 * X, 0.5 + 0.0 * X, 0.5 + 0.0 * X
    for k in tl.static_range(K):
        basis = harmonic(k, X, Y, Z)
        h0, h1, h2 = load3(sh, i * K + k, drawn)
        red, green, blue = red + basis * h0, green + basis * h1, blue + basis * h2
    infinite = float("inf")
    drawn = drawn & (tl.abs(red) < infinite) & (tl.abs(green) < infinite) & (tl.abs(blue) < infinite)
    tl.store(depth + i, tl.where(drawn, z, infinite), mask=row)

    s = splats + i * SPLAT
    tl.store(s + U, u, mask=row)
    tl.store(s + V, v, mask=row)
    tl.store(s + CONIC_A, tl.where(drawn, (vv + _BLUR) * inv_det, 0.0), mask=row)
    tl.store(s + CONIC_B, -uv * inv_det, mask=row)
    tl.store(s + CONIC_C, (uu + _BLUR) * inv_det, mask=row)
    tl.store(s + LN_OPACITY, ln_o, mask=row)
    tl.store(s + RED, tl.maximum(red, 0.0), mask=row)
    tl.store(s + GREEN, tl.maximum(green, 0.0), mask=row)
    tl.store(s + BLUE, tl.maximum(blue, 0.0), mask=row)
    tl.store(s + DEPTH, z, mask=row)
    tl.store(s + EXTENT_U, e_u, mask=row)
    tl.store(s + EXTENT_V, e_v, mask=row)


@triton.jit
def _inverse_vjp(A, B, C, v_A, v_B, v_C):
    """Gradient of Q = cov^-1: v_cov = -Q v_Q Q, where the off-diagonal number stands for two entries."""
    v_B = 0.5 * v_B
    p00, p01 = v_A * A + v_B * B, v_A * B + v_B * C
    p10, p11 = v_B * A + v_C * B, v_B * B + v_C * C
    return -(A * p00 + B * p10), -2 * (A * p01 + B * p11), -(B * p01 + C * p11)


@triton.jit(do_not_specialize=["N"])
def _project_vjp(
    xyz_W, log_scale, quat, opacity_logit, sh, T, splats, v_splats, trained,
    v_xyz_W, v_log_scale, v_quat, v_opacity_logit, v_sh, N, fx, fy, cx, cy, limit_x, limit_y,
    K: tl.constexpr, SOME: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row = i < N
    live = row & (tl.load(splats + i * SPLAT + CONIC_A, mask=row, other=0.0) > 0)  # 0 where nothing is drawn
    if SOME:
        live = live & (tl.load(trained + i, mask=row, other=0) != 0)
    X, Y, Z = load3(xyz_W, i, live)
    X, Y, Z, x, y, z = _in_camera(T, X, Y, Z)
    inv_z = 1.0 / tl.where(z > _NEAR, z, 1.0)
    x_z, y_z = x * inv_z, y * inv_z
    tx = tl.minimum(tl.maximum(x_z, -limit_x), limit_x)
    ty = tl.minimum(tl.maximum(y_z, -limit_y), limit_y)
    s0, s1, s2 = load3(log_scale, i, live)
    s0, s1, s2 = tl.exp(s0), tl.exp(s1), tl.exp(s2)
    q0, q1, q2, q3 = load4(quat, i, live)
    norm, b00, b01, b02, b10, b11, b12, b20, b21, b22 = _turned(T, q0, q1, q2, q3)
    b00, b10, b20, b01, b11, b21 = b00 * s0, b10 * s0, b20 * s0, b01 * s1, b11 * s1, b21 * s1
    b02, b12, b22 = b02 * s2, b12 * s2, b22 * s2
    a, b = fx * inv_z, fy * inv_z
    mu0, mu1, mu2 = a * (b00 - tx * b20), a * (b01 - tx * b21), a * (b02 - tx * b22)
    mv0, mv1, mv2 = b * (b10 - ty * b20), b * (b11 - ty * b21), b * (b12 - ty * b22)

    s, g = splats + i * SPLAT, v_splats + i * SPLAT
    A, B, C = (
        tl.load(s + CONIC_A, mask=live, other=0.0),
        tl.load(s + CONIC_B, mask=live, other=0.0),
        tl.load(s + CONIC_C, mask=live, other=0.0),
    )
    v_u, v_v = tl.load(g + U, mask=live, other=0.0), tl.load(g + V, mask=live, other=0.0)
    v_uu, v_uv, v_vv = _inverse_vjp(
        A, B, C, tl.load(g + CONIC_A, mask=live, other=0.0), tl.load(g + CONIC_B, mask=live, other=0.0),
        tl.load(g + CONIC_C, mask=live, other=0.0),
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
    v_z = tl.load(g + DEPTH, mask=live, other=0.0) - inv_z * (x_z * v_xz + y_z * v_yz + along)
    k0, k1, k2, k3, k4, k5, k6, k7, k8 = load_rotation(T)  # R_WC
    v_X, v_Y, v_Z = k0 * v_x + k1 * v_y + k2 * v_z, k3 * v_x + k4 * v_y + k5 * v_z, k6 * v_x + k7 * v_y + k8 * v_z

    v_s0, v_s1, v_s2 = (
        w00 * b00 + w10 * b10 + w20 * b20,
        w01 * b01 + w11 * b11 + w21 * b21,
        w02 * b02 + w12 * b12 + w22 * b22,
    )
    store3(v_log_scale, i, v_s0, v_s1, v_s2, row)
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
    e0, e1, e2, e3 = e0 - q0 * along, e1 - q1 * along, e2 - q2 * along, e3 - q3 * along
    store4(v_quat, i, e0 / norm, e1 / norm, e2 / norm, e3 / norm, row)
    opacity = 1.0 / (1.0 + tl.exp(-tl.load(opacity_logit + i, mask=live, other=0.0)))
    tl.store(v_opacity_logit + i, tl.load(g + LN_OPACITY, mask=live, other=0.0) * (1.0 - opacity), mask=row)

    distance = tl.maximum(tl.sqrt(X * X + Y * Y + Z * Z), 1e-12)
    X, Y, Z = X / distance, Y / distance, Z / distance
    # a colour that is not clamped is above zero; at zero exactly the reference lets the gradient through
    v_r = tl.where(tl.load(s + RED, mask=live, other=0.0) > 0, tl.load(g + RED, mask=live, other=0.0), 0.0)
    v_g = tl.where(tl.load(s + GREEN, mask=live, other=0.0) > 0, tl.load(g + GREEN, mask=live, other=0.0), 0.0)
    v_b = tl.where(tl.load(s + BLUE, mask=live, other=0.0) > 0, tl.load(g + BLUE, mask=live, other=0.0), 0.0)
    d0, d1, d2 = 0.0 * X, 0.0 * X, 0.0 * X
    for k in tl.static_range(K):
        basis = harmonic(k, X, Y, Z)
        if K > 1:
            h0, h1, h2 = load3(sh, i * K + k, live)
            weight = h0 * v_r + h1 * v_g + h2 * v_b
            g0, g1, g2 = harmonic_gradient(k, X, Y, Z)
            d0, d1, d2 = d0 + weight * g0, d1 + weight * g1, d2 + weight * g2
        store3(v_sh, i * K + k, basis * v_r, basis * v_g, basis * v_b, row)
    along = X * d0 + Y * d1 + Z * d2
    v_X, v_Y, v_Z = (
        v_X + (d0 - X * along) / distance,
        v_Y + (d1 - Y * along) / distance,
        v_Z + (d2 - Z * along) / distance,
    )
    store3(v_xyz_W, i, v_X, v_Y, v_Z, row)
