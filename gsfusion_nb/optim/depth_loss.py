"""Losses of a picture's depth, each with its gradient beside it."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..backends import op
from ..checks import check_number, check_positive
from ..geometry.operands import check_operand


def depth_l1(
    depth_m: Float[Tensor, "H W"],
    target_m: Float[Tensor, "H W"],
) -> Float[Tensor, ""]:
    """Mean |D^ - D| over the pixels with measured depth (target above 0), metres; 0 without any.

    D^ is the blended depth sum_k w_k z_k as ``render`` gives it. It is not divided by alpha, so
    that a pixel that the map does not cover has a large error, which also pulls the opacity up.
    Differentiable: ``depth_l1_vjp``.

    Source: Keetha et al. 2024 (SplaTAM), the depth term of the mapping loss.
    """
    has_depth = target_m > 0
    n = has_depth.sum().clamp_min(1)
    return torch.where(has_depth, depth_m - target_m, 0.0).abs().sum() / n


def depth_l1_vjp(
    depth_m: Float[Tensor, "H W"], target_m: Float[Tensor, "H W"], v_loss: float = 1.0
) -> Float[Tensor, "H W"]:
    """dL/dD^ = sign(D^ - D) / (number of pixels with measured depth), zero elsewhere."""
    has_depth = target_m > 0
    n = has_depth.sum().clamp_min(1)
    return v_loss * torch.sign(torch.where(has_depth, depth_m - target_m, 0.0)) / n


LEAST_ALPHA = 0.5
"""Below this alpha a pixel counts as not covered by the map, as in the score of the depth
(``evaluation.expected_depth_m``)."""


def expected_depth_l1(
    depth_m: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    target_m: Float[Tensor, "H W"],
    coverage: float = 0.0,
    far_m: float = math.inf,
) -> Float[Tensor, ""]:
    """Mean of w (|D^ / max(A, 1/2) - D| + k D (1 - A)) over the pixels with measured depth (target
    above 0), metres; 0 without any.

    D^ = sum_k w_k z_k is the blended depth and A = sum_k w_k alpha, so D^ / A is the mean depth of
    what a pixel shows. ``depth_l1`` does not divide: it is least where D^ = D, and there the mean
    depth is D / A, behind the surface by (1 - A) / A of its distance. What it does besides is to
    close holes: where z = D its error is D (1 - A). The second term does that, with the weight k.
    Differentiable: ``expected_depth_l1_vjp``.

    Args:
        depth_m: Blended depth, metres. [H, W]
        alpha: Alpha of the picture, 0 to 1. [H, W]
        target_m: Measured depth, metres; 0: missing. [H, W]
        coverage: k, at least 0.
        far_m: Farther pixels count w = (far_m / D)^2, others 1: nothing is mapped there, and the
            error of a depth camera grows with the square of the depth. Metres.

    Source: ours; docs/gsfusion.md has what it changes.
    """
    error_m = _expected_depth_error(depth_m, alpha, target_m).abs()
    hole_m = target_m * (1 - alpha)
    w = _pixel_weight(target_m, far_m)
    return (w * (error_m + coverage * hole_m)).sum() / (target_m > 0).sum().clamp_min(1)


def expected_depth_l1_vjp(
    depth_m: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    target_m: Float[Tensor, "H W"],
    coverage: float = 0.0,
    far_m: float = math.inf,
    v_loss: float = 1.0,
) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """dL/dD^ = w s / (n a) and dL/dA = -w s D^ / (n a^2) - w k D / n, with s the sign of the error,
    n the number of pixels with measured depth and a = max(A, 1/2); the first part of dL/dA is zero
    where A is below 1/2."""
    n = (target_m > 0).sum().clamp_min(1)
    sign = torch.sign(_expected_depth_error(depth_m, alpha, target_m))
    divisor = alpha.clamp_min(LEAST_ALPHA)
    v_depth_m = v_loss * sign / (n * divisor)
    v_alpha = torch.where(alpha < LEAST_ALPHA, 0.0, -v_depth_m * depth_m / divisor)
    w = _pixel_weight(target_m, far_m)
    return w * v_depth_m, w * (v_alpha - v_loss * coverage * target_m / n)


def _expected_depth_error(
    depth_m: Float[Tensor, "H W"], alpha: Float[Tensor, "H W"], target_m: Float[Tensor, "H W"]
) -> Float[Tensor, "H W"]:
    """D^ / max(A, 1/2) - D, metres; 0 where nothing was measured."""
    return torch.where(target_m > 0, depth_m / alpha.clamp_min(LEAST_ALPHA) - target_m, 0.0)


def _pixel_weight(target_m: Float[Tensor, "H W"], far_m: float) -> Float[Tensor, "H W"]:
    """(far_m / D)^2 beyond ``far_m``, else 1."""
    return (far_m / target_m).square().clamp_max(1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthLoss:
    """Value and gradient of the loss of a picture's depth. All are tensors, so the host need not
    wait for a GPU."""

    value: Float[Tensor, ""]
    v_depth_m: Float[Tensor, "H W"]
    """dL/dD^, of the blended depth."""
    v_alpha: Float[Tensor, "H W"]
    """dL/dA."""


def check_depth_loss(
    depth_m: Any,
    alpha: Any,
    target_m: Any,
    coverage: Any = 0.0,
    far_m: Any = math.inf,
    weight: Any = 1.0,
) -> None:
    """Raise ``ValueError`` for arguments that ``expected_depth_loss`` refuses."""
    check_operand("depth_m", depth_m, ("H", "W"))
    like = {"dtypes": (depth_m.dtype,), "device": depth_m.device}
    for name, image in (("alpha", alpha), ("target_m", target_m)):
        check_operand(name, image, tuple(depth_m.shape), **like)
    check_number("coverage", coverage, 0)
    if far_m != math.inf:
        check_positive("far_m", far_m)
    check_number("weight", weight)


@op("depth_loss", check_depth_loss)
def expected_depth_loss(
    depth_m: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    target_m: Float[Tensor, "H W"],
    coverage: float = 0.0,
    far_m: float = math.inf,
    weight: float = 1.0,
) -> DepthLoss:
    """What an optimisation step needs of the depth: ``weight`` times ``expected_depth_l1``, and its
    gradient.

    Args:
        depth_m, alpha, target_m, coverage, far_m: As for ``expected_depth_l1``.
        weight: Of the loss.
    """
    inputs = (depth_m, alpha, target_m, coverage, far_m)
    v_depth_m, v_alpha = expected_depth_l1_vjp(*inputs, weight)
    value = weight * expected_depth_l1(*inputs)
    return DepthLoss(value=value, v_depth_m=v_depth_m, v_alpha=v_alpha)
