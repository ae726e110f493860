"""What the host does before and after the kernels, whatever the backend."""

import torch
from torch import Tensor

from gsfusion_nb.optim.losses import RgbdLoss

COLOUR_VALUES, DEPTH_PIXELS, COLOUR_SUM, DEPTH_SUM = range(4)
"""What the kernels add up: values of colour and pixels with a depth loss, then sum |C - C^| and sum |D - D^|."""
N_SUMS = 4


def is_float32(*images: Tensor) -> bool:
    """Whether the kernels take these images."""
    return all(image.dtype == torch.float32 for image in images)


def limit_m(behind_m: float | None) -> float:
    """``behind_m``, or infinity for no limit."""
    return float("inf") if behind_m is None else float(behind_m)


def to_loss(values: Tensor, v_rgb: Tensor, v_depth_m: Tensor) -> RgbdLoss:
    """The result from the loss of colour, the loss of depth and their weighted sum, float32 [3], and the gradients."""
    colour, depth_m, total = values.unbind()
    return RgbdLoss(colour=colour, depth_m=depth_m, total=total, v_rgb=v_rgb, v_depth_m=v_depth_m)
