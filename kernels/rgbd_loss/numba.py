"""RTG-SLAM's loss and its gradient in two passes over the image: count, then write."""

# Arrays are passed on as a list, which pyright cannot follow:
# pyright: reportCallIssue=false

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.optim.losses import RgbdLoss
from gsfusion_nb.optim.losses import rgbd_l1_vjp as reference

from ..runtime.numba.launch import launching
from .host import COLOUR_SUM, COLOUR_VALUES, DEPTH_PIXELS, DEPTH_SUM, N_SUMS, is_float32, limit_m, to_loss

f32 = np.float32


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
    if not is_float32(*images):
        options = {"weight_colour": weight_colour, "weight_depth": weight_depth, "behind_m": behind_m}
        return reference.reference(*images, pixels, **options)
    v_rgb, v_depth_m = torch.empty_like(rgb), torch.empty_like(depth_m)
    arrays = [t.detach().contiguous().numpy() for t in (*images, pixels)]
    limit = f32(limit_m(behind_m))
    with launching():
        sums = _sums(*arrays, limit).tolist()
        n, n_known = max(sums[COLOUR_VALUES], 1.0), max(sums[DEPTH_PIXELS], 1.0)
        scale_rgb, scale_depth = f32(weight_colour / n), f32(weight_depth / n_known)
        _write(*arrays, limit, scale_rgb, scale_depth, v_rgb.numpy(), v_depth_m.numpy())
    colour, depth = sums[COLOUR_SUM] / n, sums[DEPTH_SUM] / n_known
    return to_loss(torch.tensor([colour, depth, weight_colour * colour + weight_depth * depth]), v_rgb, v_depth_m)


@njit(inline="always")
def _has_depth_loss(depth, target, limit):
    """The pixel has both depths, and the rendered one is not too far behind."""
    return depth > f32(0.0) and target > f32(0.0) and depth - target < limit


@njit(parallel=True, cache=True, error_model="numpy")
def _sums(rgb, depth, target_rgb, target_depth, pixels, limit):
    """The sums of ``host``: by rows, so that threads do not matter."""
    H, W = depth.shape
    rows = np.zeros((H, N_SUMS))
    for y in prange(H):
        for x in range(W):
            if not pixels[y, x]:
                continue
            rows[y, COLOUR_VALUES] += 3
            for c in range(3):
                rows[y, COLOUR_SUM] += abs(rgb[y, x, c] - target_rgb[y, x, c])
            if _has_depth_loss(depth[y, x], target_depth[y, x], limit):
                rows[y, DEPTH_PIXELS] += 1
                rows[y, DEPTH_SUM] += abs(depth[y, x] - target_depth[y, x])
    return rows.sum(axis=0)


@njit(inline="always")
def _sign(gap):
    """0 for a NaN. Without a branch: signs are random to the processor."""
    return f32(gap > f32(0.0)) - f32(gap < f32(0.0))


@njit(parallel=True, cache=True, error_model="numpy")
def _write(rgb, depth, target_rgb, target_depth, pixels, limit, scale_rgb, scale_depth, v_rgb, v_depth):
    """The two gradient images; every pixel is written."""
    H, W = depth.shape
    for y in prange(H):
        for x in range(W):
            v_depth[y, x] = f32(0.0)
            for c in range(3):
                v_rgb[y, x, c] = f32(0.0)
            if not pixels[y, x]:
                continue
            for c in range(3):
                v_rgb[y, x, c] = scale_rgb * _sign(rgb[y, x, c] - target_rgb[y, x, c])
            if _has_depth_loss(depth[y, x], target_depth[y, x], limit):
                v_depth[y, x] = scale_depth * _sign(depth[y, x] - target_depth[y, x])
