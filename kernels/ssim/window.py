"""The weights of SSIM's window, for the kernels."""

import functools

import torch
from torch import Tensor

from gsfusion_nb.optim.losses import WINDOW_PX, WINDOW_SIGMA_PX


@functools.cache
def window(device: torch.device) -> Tensor:
    """Weights along one axis; they add up to 1. float32 [11]"""
    offset = torch.arange(WINDOW_PX, dtype=torch.float64) - WINDOW_PX // 2
    weight = torch.exp(-0.5 * (offset / WINDOW_SIGMA_PX) ** 2)
    return (weight / weight.sum()).float().to(device)
