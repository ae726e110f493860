"""The information filter of a surfel: its centre and its normal, each with one number that says how
much is known of it (EGG-Fusion, section 3.2.2).

The state is constant (no process noise), an observation is the measured point and normal in the
world frame, and its covariance grows with the square of the depth. Then the filter of Eq. 5 to 8 is
a weighted mean.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gsfusion_nb.geometry import quaternion

SAME_NORMAL = 1e-7
"""Two normals with a smaller sine of their angle count as one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfelState:
    """The filter's state of N surfels."""

    xyz_W: Float[Tensor, "N 3"]
    """Centre, world frame, metres."""
    normal_W: Float[Tensor, "N 3"]
    """Unit normal, world frame."""
    w_p: Float[Tensor, " N"]
    """Information of the centre, 1/m^2."""
    w_n: Float[Tensor, " N"]
    """Information of the normal."""


def information(depth_m: Float[Tensor, " N"], alpha: float) -> Float[Tensor, " N"]:
    """What one observation at a depth tells: 1 / (alpha d)^2."""
    return 1 / (alpha * depth_m).square()


def fused(
    state: SurfelState,
    xyz_W: Float[Tensor, "N 3"],
    normal_W: Float[Tensor, "N 3"],
    depth_m: Float[Tensor, " N"],
    *,
    alpha_p: float,
    alpha_n: float,
) -> SurfelState:
    """The state after one observation of each surfel (Eq. 6 and 7).

    Args:
        state: Before it.
        xyz_W, normal_W: The measured point and unit normal, world frame.
        depth_m: Depth at which they were measured.
        alpha_p, alpha_n: Standard deviations of point and normal as shares of the depth.
    """
    a_p = information(depth_m, alpha_p)
    a_n = information(depth_m, alpha_n)
    w_p = state.w_p + a_p
    w_n = state.w_n + a_n
    p = (state.w_p[:, None] * state.xyz_W + a_p[:, None] * xyz_W) / w_p[:, None]
    n = state.w_n[:, None] * state.normal_W + a_n[:, None] * normal_W
    return SurfelState(xyz_W=p, normal_W=torch.nn.functional.normalize(n, dim=1), w_p=w_p, w_n=w_n)


def turned(
    quat: Float[Tensor, "N 4"], before: Float[Tensor, "N 3"], after: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 4"]:
    """Rotations that follow normals which turned, by the smaller angle (Eq. 8 and 20)."""
    is_turned = torch.linalg.cross(before, after).norm(dim=1) > SAME_NORMAL
    q = quaternion.multiply(quaternion.shortest_arc(before, after), quat)
    return torch.where(is_turned[:, None], torch.nn.functional.normalize(q, dim=1), quat)


def normals_of(quat: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3"]:
    """The z axes of surfels, which are their normals."""
    return quaternion.to_matrix(quat)[:, :, 2]
