"""Mean absolute or squared difference, its gradient and the squared error of the picture as shown,
in one pass."""

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.backends import load
from gsfusion_nb.optim.losses import PictureLoss

from ..runtime.numba.launch import launching

f32 = np.float32
_VALUE, _SQUARE = range(2)
"""Columns of the sums of a row: |C - C^| or (C - C^)^2, and (clamp C^ - C)^2."""


def l1_mse_vjp(rgb: Tensor, target: Tensor) -> PictureLoss:
    """See ``gsfusion_nb.optim.l1_mse_vjp``."""
    return _loss("l1_mse_vjp", rgb, target, squared=False)


def l2_mse_vjp(rgb: Tensor, target: Tensor) -> PictureLoss:
    """See ``gsfusion_nb.optim.l2_mse_vjp``."""
    return _loss("l2_mse_vjp", rgb, target, squared=True)


def _loss(name: str, rgb: Tensor, target: Tensor, *, squared: bool) -> PictureLoss:
    if rgb.dtype != torch.float32:
        return load(name, "reference")(rgb, target)
    v_rgb = torch.empty(rgb.shape, dtype=torch.float32)
    a, b, v = (t.detach().contiguous().view(len(rgb), -1).numpy() for t in (rgb, target, v_rgb))
    with launching():
        sums = _pass(a, b, v, f32((2 if squared else 1) / max(rgb.numel(), 1)), squared)
    means = torch.from_numpy(sums).div_(rgb.numel()).float()
    return PictureLoss(value=means[_VALUE], mse=means[_SQUARE], v_rgb=v_rgb)


@njit(parallel=True, cache=True, error_model="numpy")
def _pass(rgb, target, v_rgb, scale, squared):
    """The sums over the picture; row sums first, so that threads do not matter."""
    sums = np.zeros((len(rgb), 2))
    for y in prange(len(rgb)):
        if squared:
            _squared_row(rgb[y], target[y], v_rgb[y], scale, sums[y])
        else:
            _row(rgb[y], target[y], v_rgb[y], scale, sums[y])
    total = np.zeros(2)  # np.sum along an axis takes seconds to compile
    for y in range(len(rgb)):
        total[_VALUE] += sums[y, _VALUE]
        total[_SQUARE] += sums[y, _SQUARE]
    return total


@njit(cache=True, error_model="numpy", fastmath={"reassoc"})
def _row(rgb, target, v_rgb, scale, sums):
    """The gradient of a row of absolute differences, and its sums."""
    absolute = f32(0.0)
    square = f32(0.0)
    for i in range(len(rgb)):
        gap = rgb[i] - target[i]
        absolute += abs(gap)
        v_rgb[i] = (scale if gap > f32(0.0) else f32(0.0)) - (scale if gap < f32(0.0) else f32(0.0))
        error = min(max(rgb[i], f32(0.0)), f32(1.0)) - target[i]
        square += error * error
    sums[_VALUE] = absolute
    sums[_SQUARE] = square


@njit(cache=True, error_model="numpy", fastmath={"reassoc"})
def _squared_row(rgb, target, v_rgb, scale, sums):
    """The same for squared differences."""
    value = f32(0.0)
    square = f32(0.0)
    for i in range(len(rgb)):
        gap = rgb[i] - target[i]
        value += gap * gap
        v_rgb[i] = gap * scale
        error = min(max(rgb[i], f32(0.0)), f32(1.0)) - target[i]
        square += error * error
    sums[_VALUE] = value
    sums[_SQUARE] = square
