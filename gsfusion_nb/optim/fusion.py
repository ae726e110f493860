"""Confidence-weighted fusion with the values before a window: what keeps earlier views from being forgotten."""

from jaxtyping import Int
from torch import Tensor

from ..geometry import quaternion
from ..types import GaussianParams


def fuse_with_history(
    before: GaussianParams,
    after: GaussianParams,
    confidence_before: Int[Tensor, " N"],
    confidence_after: Int[Tensor, " N"],
    *,
    history_max_weight: float = 1.0,
) -> GaussianParams:
    """G = w_hist G_before + (1 - w_hist) G_after,  w_hist = min(history_max_weight, eta_before / eta_after).

    Quaternions are interpolated on the sphere; opacity does not change.

    Args:
        before, after: Parameters before and after the optimisation of a window.
        confidence_before, confidence_after: Confidence counts eta.
        history_max_weight: Cap on the weight of the past (paper 1, released code 0.5).

    Source: Peng et al. 2024, Eq. 9. (The released code gives all but centre and quaternion the first row's weight.)
    """
    weight = (confidence_before / confidence_after.clamp_min(1)).clamp(max=history_max_weight).to(after.xyz_W)
    w = weight[:, None]
    return GaussianParams(
        xyz_W=after.xyz_W.lerp(before.xyz_W, w),
        log_scale=after.log_scale.lerp(before.log_scale, w),
        quat=quaternion.slerp(after.quat, before.quat, weight),
        opacity_logit=after.opacity_logit,
        sh=after.sh.lerp(before.sh, w[..., None]),
    )
