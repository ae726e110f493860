"""From 3D Gaussians to 2D ones: elliptical weighted average (EWA) splatting, and its gradient.

Source: Zwicker et al. 2002, Eq. 25-31; Kerbl et al. 2023, Eq. 5-6 and appendix A; GSFusion Eq. 2-5.
The low-pass filter of 0.3 px^2, the clamp in J and the near plane are those of the code released
with Kerbl et al. 2023.

The gradient of a picture to the pose of its camera (``pose_vjp``) follows from those of the
Gaussians. Moving the camera by T_WC exp(xi) shows the same picture as moving every Gaussian by the
opposite motion: in the frame of the camera each centre x becomes exp(-xi) x and each orientation R
becomes exp(-omega) R. So the pose needs no pass over the pixels of its own: it is a sum over the
gradients that the renderer computes for the Gaussians. One term has to be taken out of this sum. A
camera that turns in place sees the same colours, whereas Gaussians that turn around it do not turn
their spherical harmonics.

Source: derived here; the tests compare it with finite differences, and with autograd through a
renderer of three lines. Other published ways to the same gradient: MonoGS (Matsuki et al. 2024, Eq.
3-6), which goes through dx_C/dxi.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..backends import piece
from ..geometry import quaternion, se3
from ..geometry.spherical_harmonics import SH_C0, sh_to_rgb_vjp
from ..types import Camera, GaussianParams
from .constants import ALPHA_MIN, FARTHEST_PX, FRUSTUM_CLAMP, NEAR_PLANE_M, SCREEN_BLUR_PX2


@dataclass(frozen=True, kw_only=True, eq=False)
class Projection:
    """The Gaussians as ellipses in the image. Rows that are not ``visible`` contain finite numbers
    without meaning."""

    uv: Float[Tensor, "N 2"]
    """Centre, pixels."""
    conic: Float[Tensor, "N 3"]
    """A, B, C of sigma = (A dx^2 + C dy^2) / 2 + B dx dy: the inverse of the 2D covariance,
    1/px^2."""
    depth_m: Float[Tensor, " N"]
    """z of the centre in the camera frame, metres."""
    opacity: Float[Tensor, " N"]
    """Peak opacity."""
    extent_px: Float[Tensor, "N 2"]
    """Half width and half height of the box outside which alpha is below 1/255, pixels. No
    gradient."""
    visible: Bool[Tensor, " N"]
    """In front of the near plane, at least 1/255 opaque, and of finite position and size."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ProjectionGradient:
    """dL/d of the Gaussian parameters that ``project_gaussians`` uses."""

    xyz_W: Float[Tensor, "N 3"]
    log_scale: Float[Tensor, "N 3"]
    quat: Float[Tensor, "N 4"]
    opacity_logit: Float[Tensor, " N"]


@piece
def project_gaussians(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    *,
    near_m: float = NEAR_PLANE_M,
) -> Projection:
    """Project every Gaussian onto the image plane.

    Args:
        params: Gaussians before activation, N rows; the colour is not used.
        camera: Pinhole camera. The clamp in J is symmetric about the image centre, whatever cx and
            cy are.
        T_WC: Camera-to-world pose.
        near_m: Distance of the near plane, metres.

    Returns:
        The screen-space Gaussians, one row per row of ``params``.

    Differentiable: ``project_gaussians_vjp``.
    """
    s = _splat(params, camera, T_WC, near_m)
    u = camera.fx * s.x / s.z + camera.cx  # GSFusion Eq. 4
    v = camera.fy * s.y / s.z + camera.cy
    opacity = params.opacity_logit.sigmoid()
    # o exp(-sigma) = 1/255 at 2 sigma = 2 ln(255 o)
    reach = 2 * (opacity / ALPHA_MIN).clamp_min(1.0).log()
    extent_px = (reach[:, None] * s.cov.diagonal(dim1=1, dim2=2)).sqrt()
    uv = torch.stack([u, v], dim=-1)
    # false for a NaN
    finite = s.depth_m.isfinite() & ((uv.abs() < FARTHEST_PX) & (extent_px < FARTHEST_PX)).all(1)
    values = {
        "uv": uv,
        "conic": torch.stack(
            [s.Q[:, 0, 0], s.Q[:, 0, 1], s.Q[:, 1, 1]],
            dim=-1,
        ),
        "depth_m": s.depth_m,
        "opacity": opacity,
        "extent_px": extent_px,
    }
    columns = {
        name: torch.where(
            finite.view(-1, *[1] * (x.ndim - 1)),
            x,
            0.0,
        )
        for name, x in values.items()
    }
    return Projection(**columns, visible=s.in_front & finite & (opacity >= ALPHA_MIN))


@piece
def project_gaussians_vjp(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    v_uv: Float[Tensor, "N 2"],
    v_conic: Float[Tensor, "N 3"],
    v_depth_m: Float[Tensor, " N"],
    v_opacity: Float[Tensor, " N"],
    *,
    near_m: float = NEAR_PLANE_M,
) -> ProjectionGradient:
    """Gradient of ``project_gaussians``, from the screen-space Gaussians to the parameters.

    Where x/z or y/z is clamped in J, it gets no gradient through J. Rows behind the near plane get
    zero.

    Args:
        params, camera, T_WC, near_m: as given to ``project_gaussians``.
        v_uv, v_conic, v_depth_m, v_opacity: dL/d of its results.
    """
    s = _splat(params, camera, T_WC, near_m)
    v_Q = _inverse_covariance_vjp(v_conic)
    v_cov = -s.Q @ v_Q @ s.Q  # Q = cov^-1, so dQ = -Q dcov Q
    # cov = M M^T + 0.3 I,  M = J W R S
    v_M = 2 * v_cov @ s.M
    v_J = v_M @ (s.W @ s.R @ s.S).mT
    v_R = (s.J @ s.W).mT @ v_M @ s.S
    v_scale_m = ((s.J @ s.W @ s.R).mT @ v_M).diagonal(dim1=1, dim2=2)  # dL/d(scale): S is diagonal
    v_log_scale = v_scale_m * params.log_scale.exp()
    v_quat = quaternion.to_matrix_vjp(params.quat, v_R)
    # u = fx x/z + cx,  v = fy y/z + cy,  J = 1/z [[fx, 0, -fx tx], [0, fy, -fy ty]]
    v_tx = -camera.fx / s.z * v_J[:, 0, 2]
    v_ty = -camera.fy / s.z * v_J[:, 1, 2]
    v_x = (camera.fx * v_uv[:, 0] + torch.where(s.tx == s.x / s.z, v_tx, 0.0)) / s.z
    v_y = (camera.fy * v_uv[:, 1] + torch.where(s.ty == s.y / s.z, v_ty, 0.0)) / s.z
    v_z = v_depth_m - (s.x * v_x + s.y * v_y + (s.J * v_J).sum((1, 2))) / s.z
    v_xyz_W = torch.stack([v_x, v_y, v_z], dim=-1) @ s.W  # x_C = W x_W + t
    in_front = s.in_front[:, None]
    opacity = params.opacity_logit.sigmoid()
    return ProjectionGradient(
        xyz_W=torch.where(in_front, v_xyz_W, 0.0),
        log_scale=torch.where(in_front, v_log_scale, 0.0),
        quat=torch.where(in_front, v_quat, 0.0),
        opacity_logit=v_opacity * opacity * (1 - opacity),  # derivative of the logistic function
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Splat:
    """A Gaussian on its way to the screen, with the papers' letters."""

    W: Float[Tensor, "3 3"]
    """Rotation of T_CW."""
    depth_m: Float[Tensor, " N"]
    in_front: Bool[Tensor, " N"]
    """Of the near plane."""
    x: Float[Tensor, " N"]
    """Centre in the camera frame; (0, 0, 1) where it is not in front."""
    y: Float[Tensor, " N"]
    z: Float[Tensor, " N"]
    tx: Float[Tensor, " N"]
    """x/z and y/z, clamped."""
    ty: Float[Tensor, " N"]
    J: Float[Tensor, "N 2 3"]
    R: Float[Tensor, "N 3 3"]
    S: Float[Tensor, "N 3 3"]
    M: Float[Tensor, "N 2 3"]
    cov: Float[Tensor, "N 2 2"]
    Q: Float[Tensor, "N 2 2"]
    """Inverse of ``cov``."""


def _splat(params: GaussianParams, camera: Camera, T_WC: Tensor, near_m: float) -> _Splat:
    T_CW = se3.inverse(T_WC.to(params.xyz_W))
    W = T_CW[:3, :3]
    xyz_C = se3.apply(T_CW, params.xyz_W)
    depth_m = xyz_C[:, 2]
    in_front = depth_m > near_m
    x, y, z = torch.where(in_front[:, None], xyz_C, xyz_C.new_tensor([0.0, 0.0, 1.0])).unbind(-1)

    limit_x = FRUSTUM_CLAMP * 0.5 * camera.width / camera.fx
    limit_y = FRUSTUM_CLAMP * 0.5 * camera.height / camera.fy
    tx = (x / z).clamp(-limit_x, limit_x)
    ty = (y / z).clamp(-limit_y, limit_y)
    o = torch.zeros_like(z)
    J = _matrix([[camera.fx / z, o, -camera.fx * tx / z], [o, camera.fy / z, -camera.fy * ty / z]])

    R = quaternion.to_matrix(params.quat)
    S = params.log_scale.exp().diag_embed()
    # Sigma = R S S^T R^T (Kerbl Eq. 6),  Sigma' = J W Sigma W^T J^T (Kerbl Eq. 5)
    M = J @ W @ R @ S  # so that Sigma' = M M^T: GSFusion Eq. 2 and 5
    cov = M @ M.mT + SCREEN_BLUR_PX2 * torch.eye(2).to(M)
    uu = cov[:, 0, 0]
    uv = cov[:, 0, 1]
    vv = cov[:, 1, 1]
    # det(M M^T + e I) = |m_u x m_v|^2 + e tr(M M^T) + e^2: for a needle, uu vv - uv^2 would lose
    # all digits in float32
    cross = torch.linalg.cross(M[:, 0], M[:, 1])
    trace = (M * M).sum((1, 2))
    det = (cross * cross).sum(-1) + SCREEN_BLUR_PX2 * trace + SCREEN_BLUR_PX2**2
    Q = _matrix([[vv, -uv], [-uv, uu]]) / det[:, None, None]
    return _Splat(
        W=W,
        depth_m=depth_m,
        in_front=in_front,
        x=x,
        y=y,
        z=z,
        tx=tx,
        ty=ty,
        J=J,
        R=R,
        S=S,
        M=M,
        cov=cov,
        Q=Q,
    )


def _inverse_covariance_vjp(v_conic: Float[Tensor, "N 3"]) -> Float[Tensor, "N 2 2"]:
    """dL/dQ of the inverse 2D covariances from dL/d of the conics, whose number B is two entries of
    Q."""
    v_A, v_B, v_C = v_conic.unbind(-1)
    return _matrix([[v_A, v_B / 2], [v_B / 2, v_C]])


def _matrix(rows: list[list[Tensor]]) -> Tensor:
    return torch.stack(
        [torch.stack(row, dim=-1) for row in rows],
        dim=-2,
    )


def intrinsics_vjp(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    v_uv: Float[Tensor, "N 2"],
    v_conic: Float[Tensor, "N 3"],
    *,
    near_m: float = NEAR_PLANE_M,
) -> Float[Tensor, " 4"]:
    """dL/d(fx, fy, cx, cy), a sum over the Gaussians.

    Args:
        params, camera, T_WC, near_m: as given to ``project_gaussians``.
        v_uv, v_conic: dL/d of its results, as ``render_vjp`` fills them.
    """
    s = _splat(params, camera, T_WC, near_m)
    v_cov = -s.Q @ _inverse_covariance_vjp(v_conic) @ s.Q
    v_J = 2 * v_cov @ s.M @ (s.W @ s.R @ s.S).mT
    # u = fx x/z + cx,  J = 1/z [[fx, 0, -fx tx], [0, fy, -fy ty]]; where tx is clamped, it is a
    # number divided by fx, and the entry does not depend on fx
    tx = torch.where(s.tx == s.x / s.z, s.tx, 0.0)
    ty = torch.where(s.ty == s.y / s.z, s.ty, 0.0)
    v_fx = (s.x * v_uv[:, 0] + v_J[:, 0, 0] - tx * v_J[:, 0, 2]) / s.z
    v_fy = (s.y * v_uv[:, 1] + v_J[:, 1, 1] - ty * v_J[:, 1, 2]) / s.z
    columns = torch.stack([v_fx, v_fy, v_uv[:, 0], v_uv[:, 1]], dim=-1)
    return torch.where(s.in_front[:, None], columns, 0.0).sum(0)


def pose_vjp(
    params: GaussianParams, v_params: GaussianParams, T_WC: Float[Tensor, "4 4"]
) -> Float[Tensor, " 6"]:
    """dL/dxi at xi = 0 for a camera at T_WC exp(xi).

    Args:
        params: The Gaussians that were drawn, N rows.
        v_params: What ``render_vjp`` returned for all of them: rows that it was told to freeze are
            missing in the sum.
        T_WC: Camera-to-world pose of the picture.

    Returns:
        Gradient with respect to the twist in the frame of the camera, translation (per metre)
        first, then rotation (per radian), as ``geometry.se3.exp`` takes it. [6]
    """
    R_WC = T_WC[:3, :3].to(params.xyz_W)
    centre_W = T_WC[:3, 3].to(params.xyz_W)
    arm = params.xyz_W - centre_W
    v_x = v_params.xyz_W  # a camera that moves by rho: dx = -rho
    v_turn = v_x
    if params.sh.shape[1] > 1:
        # dL/dsh_0 = Y_0 dL/drgb, zero where the colour was clamped
        v_rgb = v_params.sh[:, 0] / SH_C0
        v_turn = v_x - sh_to_rgb_vjp(params.sh, params.xyz_W, centre_W, v_rgb)[1]
    v_rho_W = -v_x.sum(0)
    # a camera that turns by omega: dx = -omega x arm, so  dL = -omega . (arm x dL/dx)
    v_omega_W = -torch.linalg.cross(arm, v_turn).sum(0)
    # dq = -1/2 (0, omega) q; the vector part of v q* is what all (0, omega) share
    w = params.quat[:, :1]
    v = params.quat[:, 1:]
    v_w = v_params.quat[:, :1]
    v_v = v_params.quat[:, 1:]
    v_omega_W = v_omega_W - 0.5 * (w * v_v - v_w * v + torch.linalg.cross(v, v_v)).sum(0)
    return torch.cat([v_rho_W @ R_WC, v_omega_W @ R_WC])


def pose_matrix_vjp(
    params: GaussianParams, v_params: GaussianParams, T_WC: Float[Tensor, "4 4"]
) -> Float[Tensor, "4 4"]:
    """dL/dT_WC along rigid motions; arguments as for ``pose_vjp``, whose g = (g_rho, g_omega) it
    puts into a matrix.

        v_T = [ R hat(g_omega) / 2   R g_rho ]
              [         0               0    ]

    so that <v_T, T hat(xi)> = g . xi for every twist xi. A 4x4 matrix has 16 numbers and a pose 6
    degrees of freedom. Of all matrices with this property it is the one of least norm: it has no
    part that would bend the rotation. Chained with any function that gives a rigid ``T_WC`` it is
    the exact gradient. The tests compare it with finite differences along rigid motions.
    """
    v_rho, v_omega = pose_vjp(params, v_params, T_WC).to(T_WC).split(3)
    R = T_WC[:3, :3]
    v_T = torch.zeros_like(T_WC)
    v_T[:3, :3] = R @ se3.hat(v_omega) / 2
    v_T[:3, 3] = R @ v_rho
    return v_T
