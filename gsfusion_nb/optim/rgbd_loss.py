"""RTG-SLAM's loss of colour and depth, and its gradient (Peng et al. 2024, Eq. 7)."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..backends import op
from ..checks import check_number
from ..geometry.operands import MASK, check_images, check_operand


@dataclass(frozen=True, kw_only=True, eq=False)
class RgbdLoss:
    """Value and gradient of the loss of one view. All are tensors, so the host need not wait for a
    GPU."""

    colour: Float[Tensor, ""]
    """Mean |C - C^| over the pixels and channels."""
    depth_m: Float[Tensor, ""]
    """Mean |D - D^| over the pixels that have both depths, metres."""
    total: Float[Tensor, ""]
    """w_c colour + w_d depth."""
    v_rgb: Float[Tensor, "H W 3"]
    v_depth_m: Float[Tensor, "H W"]


def check_rgbd(
    rgb: Any,
    depth_m: Any,
    target_rgb: Any,
    target_depth_m: Any,
    pixels: Any,
    **weights: float | None,
) -> None:
    """Raise ``ValueError`` for arguments that ``rgbd_l1_vjp`` refuses."""
    check_images(rgb=rgb, depth_m=depth_m, target_rgb=target_rgb, target_depth_m=target_depth_m)
    check_operand("pixels", pixels, tuple(depth_m.shape), dtypes=MASK, device=rgb.device)
    for name, value in weights.items():
        if value is not None:
            check_number(name, value)


@op("rgbd_loss", check_rgbd)
def rgbd_l1_vjp(
    rgb: Float[Tensor, "H W 3"],
    depth_m: Float[Tensor, "H W"],
    target_rgb: Float[Tensor, "H W 3"],
    target_depth_m: Float[Tensor, "H W"],
    pixels: Bool[Tensor, "H W"],
    *,
    weight_colour: float = 1.0,
    weight_depth: float = 1.0,
    behind_m: float | None = None,
) -> RgbdLoss:
    """L = w_c mean |C - C^| + w_d mean |D - D^| over ``pixels``, and dL/dC^, dL/dD^.

    Args:
        rgb, depth_m: Rendered, C^ and D^; depth 0 where no disc is hit, which has no depth loss.
        target_rgb, target_depth_m: Measured, C and D; depth 0 where missing.
        pixels: The pixels to compare. [H, W]
        weight_colour, weight_depth: w_c and w_d.
        behind_m: Depth rendered more than this behind the measurement has no loss, metres (released
            code).

    Differentiable: no; it returns the gradient, which is zero where both are equal.

    Source: Peng et al. 2024, Eq. 7-8. The third term of Eq. 8 is about Gaussians, not pixels:
    ``SurfelOptimiser``.
    """
    behind_m = math.inf if behind_m is None else behind_m
    has_depths = (
        pixels & (depth_m > 0) & (target_depth_m > 0) & (depth_m - target_depth_m < behind_m)
    )
    n = (3 * pixels.sum()).clamp_min(1)
    n_depths = has_depths.sum().clamp_min(1)
    colour_gap = torch.where(pixels[..., None], rgb - target_rgb, 0.0)
    depth_gap = torch.where(has_depths, depth_m - target_depth_m, 0.0)
    colour = colour_gap.abs().sum() / n  # RTG-SLAM Eq. 7
    depth = depth_gap.abs().sum() / n_depths
    return RgbdLoss(
        colour=colour,
        depth_m=depth,
        total=weight_colour * colour + weight_depth * depth,  # RTG-SLAM Eq. 8
        v_rgb=weight_colour * torch.sign(colour_gap) / n,
        v_depth_m=weight_depth * torch.sign(depth_gap) / n_depths,
    )
