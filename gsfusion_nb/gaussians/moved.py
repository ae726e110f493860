"""A whole map of Gaussians turned, moved and scaled, with its colours."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import quaternion
from ..geometry.turned_harmonics import turned_harmonics
from ..types import GaussianParams


def moved(
    params: GaussianParams,
    R: Float[Tensor, "3 3"],
    t: Float[Tensor, "3"] | None = None,
    *,
    scale: float = 1.0,
) -> GaussianParams:
    """The map in another frame: x -> scale R x + t. It looks the same from a camera that is moved in the same way.

    Args:
        params: The map.
        R: Rotation matrix.
        t: Shift; none by default. [3]
        scale: Factor of all lengths, > 0.
    """
    R = R.detach().to(params.xyz_W.device, torch.float64)
    xyz = scale * (params.xyz_W.double() @ R.T)
    xyz = xyz if t is None else xyz + t.to(xyz)
    turn = quaternion.from_matrix(R)
    return GaussianParams(
        xyz_W=xyz.to(params.xyz_W),
        log_scale=params.log_scale + math.log(scale) if scale != 1.0 else params.log_scale,
        quat=quaternion.multiply(turn.expand(len(params), 4), params.quat.double()).to(params.quat),
        opacity_logit=params.opacity_logit,
        sh=turned_harmonics(params.sh, R),
    )
