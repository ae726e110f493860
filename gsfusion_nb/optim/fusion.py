"""Confidence-weighted fusion with the values before a window, so that earlier views are not forgotten (Eq. 9)."""

from jaxtyping import Int
from torch import Tensor

from ..geometry import quaternion
from ..observing import observed
from ..types import GaussianParams


@observed
def fuse_with_history(
    before: GaussianParams,
    after: GaussianParams,
    confidence_before: Int[Tensor, " N"],
    confidence_after: Int[Tensor, " N"],
    *,
    history_max_weight: float = 1.0,
) -> GaussianParams:
    """G = w G_before + (1 - w) G_after,  w = min(history_max_weight, eta_before / eta_after).

    Quaternions are interpolated on the sphere; opacity does not change.

    Args:
        before, after: Parameters before and after the optimisation of a window.
        confidence_before, confidence_after: Confidence counts eta.
        history_max_weight: Largest weight of the values before (paper 1, released code 0.5).

    Differentiable: yes, through torch.

    Source: Peng et al. 2024, Eq. 9, whose w_curr is 1 - w. (The released code uses the weight of the first row for all
    parameters except centre and quaternion.)
    """
    w = (confidence_before / confidence_after.clamp_min(1)).clamp(max=history_max_weight).to(after.xyz_W)
    w_1, w_2 = w[:, None], w[:, None, None]
    return GaussianParams(
        xyz_W=w_1 * before.xyz_W + (1 - w_1) * after.xyz_W,  # RTG-SLAM Eq. 9, for each parameter
        log_scale=w_1 * before.log_scale + (1 - w_1) * after.log_scale,
        quat=quaternion.slerp(after.quat, before.quat, w),
        opacity_logit=after.opacity_logit,
        sh=w_2 * before.sh + (1 - w_2) * after.sh,
    )
