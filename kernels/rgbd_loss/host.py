"""What the host does before and after the kernels, whatever the backend."""

import torch
from torch import Tensor

from gsfusion_nb.optim.rgbd_loss import RgbdLoss


def is_float32(*images: Tensor) -> bool:
    """Whether the kernels take these images."""
    return all(image.dtype == torch.float32 for image in images)


def limit_m(behind_m: float | None) -> float:
    """``behind_m``, or infinity for no limit."""
    return float("inf") if behind_m is None else float(behind_m)


def counts(sums: Tensor) -> Tensor:
    """Colour values and pixels with a depth loss, at least 1, from the kernels' four sums. float64 [2]"""
    return sums[:2].clamp_min(1.0)


def to_loss(sums: Tensor, weights: tuple[float, float], v_rgb: Tensor, v_depth_m: Tensor) -> RgbdLoss:
    """The result from the kernels' sums: colour values, pixels with a depth loss, sum |C - C^|, sum |D - D^|.

    Args:
        sums: float64 [4]
        weights: w_c and w_d.
    """
    colour, depth_m = (sums[2:] / counts(sums)).float()
    total = weights[0] * colour + weights[1] * depth_m
    return RgbdLoss(colour=colour, depth_m=depth_m, total=total, v_rgb=v_rgb, v_depth_m=v_depth_m)
