"""From 3D Gaussians to 2D ones: elliptical weighted average (EWA) splatting, and its gradient written out.

    x_C = R x_W + t                                            R, t of T_CW
    u = fx x/z + cx,  v = fy y/z + cy
    J = [[fx/z, 0, -fx tx/z], [0, fy/z, -fy ty/z]]             tx, ty: x/z, y/z clamped to 1.3 half fields of view
    M = J R R_q S  (2x3),   cov = M M^T + 0.3 I,   conic = cov^-1

Source: Zwicker et al. 2002, eq. 25-31; Kerbl et al. 2023, eq. 5-6; blur, clamp and near plane as in its released code.
Inside this file vectors are stored component first, [3, N], so that each line works on N contiguous numbers.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..backends import op
from ..constants import ALPHA_MIN, FRUSTUM_CLAMP, NEAR_PLANE_M, SCREEN_BLUR_PX2
from ..geometry import quaternion, se3
from ..types import Camera, GaussianParams


@dataclass(frozen=True, kw_only=True, eq=False)
class Projection:
    """The Gaussians as ellipses on the screen. Rows that are not ``visible`` hold finite, meaningless numbers."""

    uv: Float[Tensor, "N 2"]
    """Centre, pixels."""
    conic: Float[Tensor, "N 3"]
    """A, B, C of sigma = (A dx^2 + C dy^2) / 2 + B dx dy: the inverse of the 2D covariance, 1/px^2."""
    depth_m: Float[Tensor, " N"]
    """z of the centre in the camera frame, metres."""
    opacity: Float[Tensor, " N"]
    """Peak opacity."""
    extent_px: Float[Tensor, "N 2"]
    """Half width and half height of the box outside which alpha is below 1/255, pixels. No gradient."""
    visible: Bool[Tensor, " N"]
    """In front of the near plane and at least 1/255 opaque."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ProjectionGradient:
    """dL/d of the parameters that ``project_gaussians`` uses."""

    xyz_W: Float[Tensor, "N 3"]
    log_scale: Float[Tensor, "N 3"]
    quat: Float[Tensor, "N 4"]
    opacity_logit: Float[Tensor, " N"]


@op("project")
def project_gaussians(params: GaussianParams, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> Projection:
    """Project every Gaussian onto the image plane (equations at the top of this file).

    extent = sqrt(2 ln(255 o) cov_uu), likewise for v: where o exp(-sigma) falls to 1/255.

    Args:
        params: Gaussians before activation, N rows; the colour is not used.
        camera: Pinhole camera. The clamp of J is symmetric about the image centre, whatever cx and cy are.
        T_WC: Camera-to-world pose.

    Returns:
        The screen-space Gaussians, one row per row of ``params``.

    Differentiable: ``project_gaussians_vjp``.
    """
    s = _project(params, camera, T_WC)
    u = camera.fx * s.x_z + camera.cx
    v = camera.fy * s.y_z + camera.cy
    opacity = params.opacity_logit.sigmoid()
    visible = (s.depth_m > NEAR_PLANE_M) & (opacity >= ALPHA_MIN)
    reach = 2.0 * (opacity / ALPHA_MIN).clamp_min(1.0).log()
    return Projection(
        uv=torch.stack([u, v], dim=-1),
        conic=s.conic.T.contiguous(),
        depth_m=s.depth_m,
        opacity=opacity,
        extent_px=torch.stack([reach * s.cov_uu, reach * s.cov_vv], dim=-1).sqrt_(),
        visible=visible,
    )


@op("project")
def project_gaussians_vjp(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    v_uv: Float[Tensor, "N 2"],
    v_conic: Float[Tensor, "N 3"],
    v_depth_m: Float[Tensor, " N"],
    v_opacity: Float[Tensor, " N"],
) -> ProjectionGradient:
    """Gradient of ``project_gaussians``, from the screen-space Gaussians to the parameters.

    Rows behind the near plane get zero. Where x/z or y/z is clamped in J, J gives it no gradient, as the forward says.

    Args:
        params, camera, T_WC: as given to ``project_gaussians``.
        v_uv, v_conic, v_depth_m, v_opacity: dL/d of its results.
    """
    s = _project(params, camera, T_WC)
    in_front = s.depth_m > NEAR_PLANE_M
    v_u, v_v = (v_uv.T * in_front).unbind(0)
    v_uu, v_uv_, v_vv = _inverse_vjp(s.conic, v_conic.T * in_front)

    # cov = M M^T: its three entries in terms of the rows of M
    v_mu = 2 * v_uu * s.m_u + v_uv_ * s.m_v
    v_mv = 2 * v_vv * s.m_v + v_uv_ * s.m_u
    # m_u = a (B_0 - tx B_2),  m_v = b (B_1 - ty B_2),  a = fx / z,  b = fy / z
    a, b = camera.fx * s.inv_z, camera.fy * s.inv_z
    v_B = torch.stack([a * v_mu, b * v_mv, -(a * s.tx * v_mu + b * s.ty * v_mv)])
    v_tx = -a * (s.B[2] * v_mu).sum(0)
    v_ty = -b * (s.B[2] * v_mv).sum(0)

    # x/z and y/z appear in u, v and, unless clamped, in J
    v_xz = camera.fx * v_u + v_tx * (s.tx == s.x_z)
    v_yz = camera.fy * v_v + v_ty * (s.ty == s.y_z)
    v_x = v_xz * s.inv_z
    v_y = v_yz * s.inv_z
    v_z = v_depth_m * in_front
    v_z = v_z - s.inv_z * (s.x_z * v_xz + s.y_z * v_yz + (s.m_u * v_mu).sum(0) + (s.m_v * v_mv).sum(0))
    v_xyz_W = s.R_CW.T @ torch.stack([v_x, v_y, v_z])

    # B = R_CW R_q S, column k is scaled by s_k = exp(log_scale_k)
    v_log_scale = (v_B * s.B).sum(0)
    v_R_q = (s.R_CW.T @ v_B.flatten(1)).view_as(v_B) * s.scale_m
    return ProjectionGradient(
        xyz_W=v_xyz_W.T.contiguous(),
        log_scale=v_log_scale.T.contiguous(),
        quat=_rotation_vjp(params.quat, v_R_q),
        opacity_logit=v_opacity * s.opacity_slope(params),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Steps:
    """Intermediate values of the projection, component first; the gradient recomputes them instead of saving them."""

    R_CW: Tensor  # [3, 3]
    depth_m: Tensor  # [N]
    inv_z: Tensor  # [N] 1 / z, and 1 where z is behind the near plane
    x_z: Tensor  # [N]
    y_z: Tensor  # [N]
    tx: Tensor  # [N] x_z clamped
    ty: Tensor  # [N]
    scale_m: Tensor  # [3, N]
    B: Tensor  # [3, 3, N] R_CW R_q S
    m_u: Tensor  # [3, N] rows of M = J B
    m_v: Tensor  # [3, N]
    cov_uu: Tensor  # [N]
    cov_vv: Tensor  # [N]
    conic: Tensor  # [3, N]

    def opacity_slope(self, params: GaussianParams) -> Tensor:
        """d opacity / d logit = o (1 - o)."""
        o = params.opacity_logit.sigmoid()
        return o * (1 - o)


def _project(params: GaussianParams, camera: Camera, T_WC: Tensor) -> _Steps:
    T_CW = se3.inverse(T_WC.to(params.xyz_W))
    R_CW = T_CW[:3, :3]
    x, y, z = R_CW @ params.xyz_W.T + T_CW[:3, 3:]
    inv_z = torch.where(z > NEAR_PLANE_M, z, torch.ones_like(z)).reciprocal()
    x_z, y_z = x * inv_z, y * inv_z
    limit_x = FRUSTUM_CLAMP * 0.5 * camera.width / camera.fx
    limit_y = FRUSTUM_CLAMP * 0.5 * camera.height / camera.fy
    tx, ty = x_z.clamp(-limit_x, limit_x), y_z.clamp(-limit_y, limit_y)

    scale_m = params.log_scale.T.exp()
    R_q = quaternion.to_matrix(params.quat).permute(1, 2, 0).contiguous()
    B = (R_CW @ R_q.flatten(1)).view_as(R_q) * scale_m
    m_u = (camera.fx * inv_z) * (B[0] - tx * B[2])  # rows of M = J B; J's zeros are left out
    m_v = (camera.fy * inv_z) * (B[1] - ty * B[2])
    uu, vv, uv = (m_u * m_u).sum(0), (m_v * m_v).sum(0), (m_u * m_v).sum(0)
    cov_uu, cov_vv = uu + SCREEN_BLUR_PX2, vv + SCREEN_BLUR_PX2
    # det(M M^T + e I) = |m_u x m_v|^2 + e (uu + vv) + e^2: no difference of large numbers, unlike cov_uu cov_vv - uv^2
    cross = torch.linalg.cross(m_u, m_v, dim=0)
    det = (cross * cross).sum(0) + SCREEN_BLUR_PX2 * (uu + vv) + SCREEN_BLUR_PX2**2
    return _Steps(
        R_CW=R_CW, depth_m=z, inv_z=inv_z, x_z=x_z, y_z=y_z, tx=tx, ty=ty, scale_m=scale_m, B=B,
        m_u=m_u, m_v=m_v, cov_uu=cov_uu, cov_vv=cov_vv, conic=torch.stack([cov_vv, -uv, cov_uu]) / det,
    )  # fmt: skip


def _inverse_vjp(conic: Tensor, v_conic: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Gradient of Q = cov^-1:  v_cov = -Q v_Q Q, where the off-diagonal number stands for two entries of the matrix."""
    A, B, C = conic
    v_A, v_B, v_C = v_conic[0], 0.5 * v_conic[1], v_conic[2]
    p00, p01 = v_A * A + v_B * B, v_A * B + v_B * C  # v_Q Q
    p10, p11 = v_B * A + v_C * B, v_B * B + v_C * C
    return -(A * p00 + B * p10), -2 * (A * p01 + B * p11), -(B * p01 + C * p11)


def _rotation_vjp(quat: Tensor, v_R: Tensor) -> Tensor:
    """Gradient of ``quaternion.to_matrix``: dR/dq of the unit quaternion, then v_q = (v - q (q.v)) / |q|."""
    norm = quat.norm(dim=-1).clamp_min(1e-12)
    q = quat.T / norm
    w, x, y, z = q
    plus = v_R + v_R.transpose(0, 1)
    minus = v_R - v_R.transpose(0, 1)
    v_w = x * minus[2, 1] + y * minus[0, 2] + z * minus[1, 0]
    v_x = y * plus[0, 1] + z * plus[0, 2] + w * minus[2, 1] - x * (plus[1, 1] + plus[2, 2])
    v_y = x * plus[0, 1] + z * plus[1, 2] + w * minus[0, 2] - y * (plus[0, 0] + plus[2, 2])
    v_z = x * plus[0, 2] + y * plus[1, 2] + w * minus[1, 0] - z * (plus[0, 0] + plus[1, 1])
    v = 2 * torch.stack([v_w, v_x, v_y, v_z])
    return ((v - q * (q * v).sum(0)) / norm).T.contiguous()
