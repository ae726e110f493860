"""Loss of a picture's depth and its gradient in two passes over the image: count and add up, then
write. Each value of the gradient is rounded as in the reference."""

# Arrays are passed on as a list, which pyright cannot follow:
# pyright: reportCallIssue=false

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.backends import load
from gsfusion_nb.optim.depth_loss import LEAST_ALPHA, DepthLoss

from ..runtime.numba.launch import launching

f32 = np.float32
_ZERO = f32(0.0)
_ONE = f32(1.0)
_LEAST_ALPHA = f32(LEAST_ALPHA)
_PIXELS, _ERROR, _HOLES = range(3)
"""What is added up of each row: pixels with measured depth, sum w |D^ / a - D|, sum w D (1 - A)."""


def expected_depth_loss(
    depth_m: Tensor,
    alpha: Tensor,
    target_m: Tensor,
    coverage: float = 0.0,
    far_m: float = math.inf,
    weight: float = 1.0,
) -> DepthLoss:
    """See ``gsfusion_nb.optim.expected_depth_loss``."""
    if depth_m.dtype != torch.float32:
        plain = load("expected_depth_loss", "reference")
        return plain(depth_m, alpha, target_m, coverage, far_m, weight)
    v_depth_m, v_alpha = torch.empty(2, *depth_m.shape, dtype=torch.float32)
    images = [image.detach().contiguous().numpy() for image in (depth_m, alpha, target_m)]
    with launching():
        sums = _row_sums(*images, f32(far_m)).sum(axis=0)
        n = f32(max(sums[_PIXELS], 1.0))
        scales = (f32(weight), f32(weight * coverage), n, f32(far_m))
        _write(*images, scales, v_depth_m.numpy(), v_alpha.numpy())
    value = weight * (sums[_ERROR] + coverage * sums[_HOLES]) / n
    return DepthLoss(
        value=torch.tensor(value, dtype=torch.float32), v_depth_m=v_depth_m, v_alpha=v_alpha
    )


@njit(inline="always")
def _pixel_weight(target, far):
    """(far / D)^2 beyond ``far``, else 1."""
    ratio = far / target
    return min(ratio * ratio, _ONE)


@njit(parallel=True, cache=True, error_model="numpy")
def _row_sums(depth, alpha, target, far):
    """The three sums of each row [H, 3]; rows first, so that threads do not matter."""
    H = depth.shape[0]
    sums = np.zeros((H, 3))
    for y in prange(H):
        _add_up_row(depth[y], alpha[y], target[y], far, sums[y])
    return sums


@njit(cache=True, error_model="numpy", fastmath={"reassoc"})
def _add_up_row(depth, alpha, target, far, sums):
    """The sums of one row."""
    n = 0
    error = _ZERO
    holes = _ZERO
    for x in range(depth.shape[0]):
        is_measured = target[x] > _ZERO
        n += is_measured
        w = _pixel_weight(target[x], far)
        gap = abs(depth[x] / max(alpha[x], _LEAST_ALPHA) - target[x])
        error += w * gap if is_measured else _ZERO
        holes += w * (target[x] * (_ONE - alpha[x]))
    sums[_PIXELS] = n
    sums[_ERROR] = error
    sums[_HOLES] = holes


@njit(parallel=True, cache=True, error_model="numpy")
def _write(depth, alpha, target, scales, v_depth, v_alpha):
    """The two gradient images; every pixel is written. scales: weight, weight times coverage,
    number of pixels with measured depth, far_m."""
    weight, hole_weight, n, far = scales
    H, W = depth.shape
    for y in prange(H):
        for x in range(W):
            divisor = max(alpha[y, x], _LEAST_ALPHA)
            gap = depth[y, x] / divisor - target[y, x]
            is_measured = target[y, x] > _ZERO
            above = weight if (gap > _ZERO) & is_measured else _ZERO
            below = weight if (gap < _ZERO) & is_measured else _ZERO
            v = (above - below) / (n * divisor)
            w = _pixel_weight(target[y, x], far)
            v_depth[y, x] = w * v
            is_covered = alpha[y, x] >= _LEAST_ALPHA
            over = -v * depth[y, x] / divisor if is_covered else _ZERO
            v_alpha[y, x] = w * (over - hole_weight * target[y, x] / n)
