"""L1 loss, its gradient and the squared error of the picture as shown, in one pass."""

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.optim import losses as reference

from ..runtime.numba.launch import launching

f32 = np.float32
_ABSOLUTE, _SQUARE = range(2)
"""Columns of the sums of a row: |C - C^| and (clamp C^ - C)^2."""


def l1_mse_vjp(rgb: Tensor, target: Tensor) -> reference.L1Loss:
    """See ``gsfusion_nb.optim.l1_mse_vjp``."""
    if rgb.dtype != torch.float32 or target.dtype != torch.float32 or rgb.shape != target.shape:
        return reference.l1_mse_vjp.reference(rgb, target)
    v_rgb = torch.empty(rgb.shape, dtype=torch.float32)
    a, b, v = (t.detach().contiguous().view(len(rgb), -1).numpy() for t in (rgb, target, v_rgb))
    with launching():
        sums = _pass(a, b, v, f32(1 / max(rgb.numel(), 1)))
    means = torch.from_numpy(sums).div_(rgb.numel()).float()
    return reference.L1Loss(value=means[_ABSOLUTE], mse=means[_SQUARE], v_rgb=v_rgb)


@njit(parallel=True, cache=True, error_model="numpy")
def _pass(rgb, target, v_rgb, scale):
    """The sums over the picture; row sums first, so that threads do not matter."""
    sums = np.zeros((len(rgb), 2))
    for y in prange(len(rgb)):
        _row(rgb[y], target[y], v_rgb[y], scale, sums[y])
    return sums.sum(axis=0)


@njit(cache=True, error_model="numpy", fastmath={"reassoc"})
def _row(rgb, target, v_rgb, scale, sums):
    """The gradient of a row, and its sums."""
    absolute, square = f32(0.0), f32(0.0)
    for i in range(len(rgb)):
        gap = rgb[i] - target[i]
        absolute += abs(gap)
        v_rgb[i] = (scale if gap > f32(0.0) else f32(0.0)) - (scale if gap < f32(0.0) else f32(0.0))
        off = min(max(rgb[i], f32(0.0)), f32(1.0)) - target[i]
        square += off * off
    sums[_ABSOLUTE], sums[_SQUARE] = absolute, square
