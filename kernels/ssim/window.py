"""The weights of SSIM's window, for the kernels.

Order of the pictures that the kernels keep between their passes, shared by numba and Triton.
"""

import functools

import torch
from torch import Tensor

from gsfusion_nb.optim.structural import WINDOW_PX, WINDOW_SIGMA_PX


@functools.cache
def window(device: torch.device) -> Tensor:
    """Weights along one axis; they add up to 1. float32 [11]"""
    offset = torch.arange(WINDOW_PX, dtype=torch.float64) - WINDOW_PX // 2
    weight = torch.exp(-0.5 * (offset / WINDOW_SIGMA_PX) ** 2)
    return (weight / weight.sum()).float().to(device)


X, Y, XX, YY, XY = range(5)
"""Window averages: of both pictures, of their squares and of their product."""
N_MEANS = 5

BY_MEAN, BY_SQUARE, BY_PRODUCT = range(3)
"""Derivatives of SSIM by the averages of x, x^2 and x y; later the window averages of these."""
N_TERMS = 3
