"""The gradient of a picture to the pose of its camera, from the gradients of the Gaussians.

Moving the camera by T_WC exp(xi) shows the same picture as moving every Gaussian by the opposite motion: in the frame
of the camera each centre x becomes exp(-xi) x and each orientation R becomes exp(-omega) R. So the pose needs no pass
over the pixels of its own: it is a sum over the gradients that the renderer computes for the Gaussians. One term has to
be taken out of this sum. A camera that turns in place sees the same colours, whereas Gaussians that turn around it do
not turn their spherical harmonics.

Source: derived here; the tests compare it with finite differences, and with autograd through a renderer of three lines.
Other published ways to the same gradient: MonoGS (Matsuki et al. 2024, Eq. 3-6), which goes through dx_C/dxi.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from ..constants import SH_C0
from ..geometry import se3
from ..geometry.spherical_harmonics import sh_to_rgb_vjp
from ..types import GaussianParams


def pose_vjp(params: GaussianParams, v_params: GaussianParams, T_WC: Float[Tensor, "4 4"]) -> Float[Tensor, " 6"]:
    """dL/dxi at xi = 0 for a camera at T_WC exp(xi).

    Args:
        params: The Gaussians that were drawn, N rows.
        v_params: What ``render_vjp`` returned for all of them: rows that it was told to freeze are missing in the sum.
        T_WC: Camera-to-world pose of the picture.

    Returns:
        Gradient with respect to the twist in the frame of the camera, translation (per metre) first, then rotation (per
        radian), as ``geometry.se3.exp`` takes it. [6]
    """
    R_WC, centre_W = T_WC[:3, :3].to(params.xyz_W), T_WC[:3, 3].to(params.xyz_W)
    arm = params.xyz_W - centre_W
    v_x = v_params.xyz_W  # a camera that moves by rho: dx = -rho
    v_turn = v_x
    if params.sh.shape[1] > 1:
        v_rgb = v_params.sh[:, 0] / SH_C0  # dL/dsh_0 = Y_0 dL/drgb, zero where the colour was clamped
        v_turn = v_x - sh_to_rgb_vjp(params.sh, params.xyz_W, centre_W, v_rgb)[1]
    v_rho_W = -v_x.sum(0)
    # a camera that turns by omega: dx = -omega x arm, so  dL = -omega . (arm x dL/dx)
    v_omega_W = -torch.linalg.cross(arm, v_turn).sum(0)
    # dq = -1/2 (0, omega) q; the vector part of v q* is what all (0, omega) share
    w, v = params.quat[:, :1], params.quat[:, 1:]
    v_w, v_v = v_params.quat[:, :1], v_params.quat[:, 1:]
    v_omega_W = v_omega_W - 0.5 * (w * v_v - v_w * v + torch.linalg.cross(v, v_v)).sum(0)
    return torch.cat([v_rho_W @ R_WC, v_omega_W @ R_WC])


def pose_matrix_vjp(
    params: GaussianParams, v_params: GaussianParams, T_WC: Float[Tensor, "4 4"]
) -> Float[Tensor, "4 4"]:
    """dL/dT_WC along rigid motions; arguments as for ``pose_vjp``, whose g = (g_rho, g_omega) it puts into a matrix.

        v_T = [R hat(g_omega) / 2,  R g_rho;  0, 0],      so that  <v_T, T hat(xi)> = g . xi  for every twist xi

    A 4x4 matrix has 16 numbers and a pose 6 degrees of freedom. Of all matrices with this property it is the one of
    least norm: it has no part that would bend the rotation. Chained with any function that gives a rigid ``T_WC`` it
    is the exact gradient. The tests compare it with finite differences along rigid motions.
    """
    v_rho, v_omega = pose_vjp(params, v_params, T_WC).to(T_WC).split(3)
    R = T_WC[:3, :3]
    v_T = torch.zeros_like(T_WC)
    v_T[:3, :3] = R @ se3.hat(v_omega) / 2
    v_T[:3, 3] = R @ v_rho
    return v_T
