"""RTG-SLAM's loss and its gradient in two passes over the image: count and add up, then write."""

# Arrays are passed on as a list, which pyright cannot follow:
# pyright: reportCallIssue=false

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.optim.rgbd_loss import RgbdLoss
from gsfusion_nb.optim.rgbd_loss import rgbd_l1_vjp as reference

from ..runtime.numba.launch import launching

f32 = np.float32
_ZERO = f32(0.0)
_PIXELS, _DEPTH_PIXELS, _COLOUR_SUM, _DEPTH_SUM = range(4)
"""What is added up of each row: pixels with a colour loss and with a depth loss, then sum |C - C^|
and sum |D - D^|."""


def rgbd_l1_vjp(
    rgb: Tensor,
    depth_m: Tensor,
    target_rgb: Tensor,
    target_depth_m: Tensor,
    pixels: Tensor,
    *,
    weight_colour: float = 1.0,
    weight_depth: float = 1.0,
    behind_m: float | None = None,
) -> RgbdLoss:
    """See ``gsfusion_nb.optim.rgbd_l1_vjp``."""
    images = (rgb, depth_m, target_rgb, target_depth_m)
    if any(image.dtype != torch.float32 for image in images):
        options = {
            "weight_colour": weight_colour,
            "weight_depth": weight_depth,
            "behind_m": behind_m,
        }
        return reference.reference(*images, pixels, **options)
    v_rgb = torch.empty(rgb.shape, dtype=torch.float32)
    v_depth_m = torch.empty(depth_m.shape, dtype=torch.float32)
    arrays = [image.detach().contiguous().numpy() for image in (*images, pixels)]
    limit = f32(np.inf if behind_m is None else behind_m)
    with launching():
        sums = _row_sums(*arrays, limit).sum(axis=0)
        n = max(f32(3 * sums[_PIXELS]), f32(1))
        n_depths = max(f32(sums[_DEPTH_PIXELS]), f32(1))
        scales = (f32(weight_colour) / n, f32(weight_depth) / n_depths)
        _write(*arrays, limit, scales, v_rgb.numpy(), v_depth_m.numpy())
    colour = torch.tensor(sums[_COLOUR_SUM] / n, dtype=torch.float32)
    depth = torch.tensor(sums[_DEPTH_SUM] / n_depths, dtype=torch.float32)
    return RgbdLoss(
        colour=colour,
        depth_m=depth,
        total=weight_colour * colour + weight_depth * depth,
        v_rgb=v_rgb,
        v_depth_m=v_depth_m,
    )


@njit(inline="always")
def _has_depths(depth, target, limit):
    """Whether a pixel has a depth loss."""
    return (depth > _ZERO) & (target > _ZERO) & (depth - target < limit)


@njit(parallel=True, cache=True, error_model="numpy")
def _row_sums(rgb, depth, target_rgb, target_depth, pixels, limit):
    """The four sums of each row [H, 4]; rows first, so that threads do not matter."""
    H = depth.shape[0]
    sums = np.zeros((H, 4))
    for y in prange(H):
        _add_up_row(rgb[y], depth[y], target_rgb[y], target_depth[y], pixels[y], limit, sums[y])
    return sums


@njit(cache=True, error_model="numpy", fastmath={"reassoc"})
def _add_up_row(rgb, depth, target_rgb, target_depth, pixels, limit, sums):
    """The sums of one row."""
    n = 0
    n_depths = 0
    colour_sum = _ZERO
    depth_sum = _ZERO
    for x in range(depth.shape[0]):
        gap = (
            abs(rgb[x, 0] - target_rgb[x, 0])
            + abs(rgb[x, 1] - target_rgb[x, 1])
            + abs(rgb[x, 2] - target_rgb[x, 2])
        )
        n += pixels[x]
        colour_sum += gap if pixels[x] else _ZERO
        has_loss = pixels[x] & _has_depths(depth[x], target_depth[x], limit)
        n_depths += has_loss
        depth_sum += abs(depth[x] - target_depth[x]) if has_loss else _ZERO
    sums[_PIXELS] = n
    sums[_DEPTH_PIXELS] = n_depths
    sums[_COLOUR_SUM] = colour_sum
    sums[_DEPTH_SUM] = depth_sum


@njit(inline="always")
def _signed(scale, gap):
    """``scale`` with the sign of ``gap``, 0 where that is 0 or NaN."""
    return (scale if gap > _ZERO else _ZERO) - (scale if gap < _ZERO else _ZERO)


@njit(parallel=True, cache=True, error_model="numpy")
def _write(rgb, depth, target_rgb, target_depth, pixels, limit, scales, v_rgb, v_depth):
    """The two gradient images; every pixel is written. scales: of a colour and of a depth."""
    colour_scale, depth_scale = scales
    H, W = depth.shape
    for y in prange(H):
        for x in range(W):
            scale = colour_scale if pixels[y, x] else _ZERO
            for c in range(3):
                v_rgb[y, x, c] = _signed(scale, rgb[y, x, c] - target_rgb[y, x, c])
            has_loss = pixels[y, x] & _has_depths(depth[y, x], target_depth[y, x], limit)
            scale = depth_scale if has_loss else _ZERO
            v_depth[y, x] = _signed(scale, depth[y, x] - target_depth[y, x])
