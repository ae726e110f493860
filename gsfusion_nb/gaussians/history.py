"""Surfels fused with what they were before an optimisation, so that earlier views are not forgotten
(Peng et al. 2024, Eq. 9)."""

from jaxtyping import Float, Int
from torch import Tensor

from ..backends import piece
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
    """G = w G_before + (1 - w) G_after,  w = min(history_max_weight, eta_before / eta_after).

    Quaternions are interpolated on the sphere; opacity does not change.

    Args:
        before, after: Parameters before and after the optimisation of a window.
        confidence_before, confidence_after: Confidence counts eta.
        history_max_weight: Largest weight of the values before (paper 1, released code 0.5).

    Differentiable: yes, through torch.

    Source: Peng et al. 2024, Eq. 9, whose w_curr is 1 - w. (The released code uses the weight of
    the first row for all parameters except centre and quaternion.)
    """
    w = _weight_of_history(confidence_before, confidence_after, history_max_weight).to(after.xyz_W)

    def history_mean(name: str) -> Tensor:
        rows = [getattr(params, name).flatten(1) for params in (before, after)]
        mean = fuse(
            *rows, confidence_before, confidence_after, history_max_weight=history_max_weight
        )
        return mean.view_as(getattr(after, name))

    return GaussianParams(
        xyz_W=history_mean("xyz_W"),
        log_scale=history_mean("log_scale"),
        quat=quaternion.slerp(after.quat, before.quat, w),
        opacity_logit=after.opacity_logit,
        sh=history_mean("sh"),
    )


@piece
def fuse(
    before: Float[Tensor, "N K"],
    after: Float[Tensor, "N K"],
    confidence_before: Int[Tensor, " N"],
    confidence_after: Int[Tensor, " N"],
    *,
    history_max_weight: float = 1.0,
) -> Float[Tensor, "N K"]:
    """Values after a window, fused with those before it; arguments as for ``fuse_with_history``.

    Differentiable: yes, through torch. Source: Peng et al. 2024, Eq. 9.
    """
    w = _weight_of_history(confidence_before, confidence_after, history_max_weight).to(after)[
        :, None
    ]
    return w * before + (1 - w) * after  # RTG-SLAM Eq. 9


def _weight_of_history(
    before: Int[Tensor, " N"], after: Int[Tensor, " N"], largest: float
) -> Float[Tensor, " N"]:
    return (before / after.clamp_min(1)).clamp(max=largest)
