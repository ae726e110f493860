"""Points of one depth image moved into another: the pixels they fall on, and how depth and
brightness differ there.

What a check-up fits and what a run watches is measured by these functions.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from ...types import Camera

USABLE_GREY = (12, 243)
"""Grey levels between which brightness can be compared: neither black nor white."""
FEWEST_GREYS = 30
"""Of two pictures, to compare their brightness."""


class Reprojection(NamedTuple):
    """Points of the first frames of P pairs in the second frames."""

    uv_b: Float[Tensor, "P N 2"]
    """Pixels of the second frames' camera; continuous, the centre of pixel (i, j) is (i + 0.5, j +
    0.5)."""
    residual: Float[Tensor, "P N"]
    """Relative depth difference (predicted - measured) / measured, 0 where it is unknown."""
    known: Bool[Tensor, "P N"]
    """Whether the point is in front of the camera and falls on a measured depth, between four
    pixels of one surface."""


def reproject_depth(
    camera: Camera,
    uv_a: Float[Tensor, "P N 2"],
    depth_a: Float[Tensor, "P N"],
    depth_b: Float[Tensor, "P H W"],
    T_ba: Float[Tensor, "P 4 4"],
    *,
    is_ray: bool = False,
) -> Reprojection:
    """Move points from frame to frame and compare with the depth that is measured there.

    The measured depth is interpolated between four pixels of one surface; points between two
    surfaces are not compared.

    Args:
        camera: Of all frames.
        uv_a: Pixels of the first frames.
        depth_a: Depth of these, metres, 0 = missing.
        depth_b: Depth images of the second frames, metres, 0 = missing.
        T_ba: Transforms from the first cameras to the second ones.
        is_ray: Whether depth is the length of each pixel's ray, not along the optical axis.
    """
    x = (uv_a[..., 0] - camera.cx) / camera.fx
    y = (uv_a[..., 1] - camera.cy) / camera.fy
    z = depth_a / (1 + x * x + y * y).sqrt() if is_ray else depth_a
    P = torch.stack([x * z, y * z, z], -1)
    Q = P @ T_ba[:, :3, :3].transpose(1, 2) + T_ba[:, None, :3, 3]
    ok = (depth_a > 0) & (Q[..., 2] > 1e-6) & torch.isfinite(Q).all(-1)
    Q = Q.where(ok[..., None], 1.0)
    xb = Q[..., 0] / Q[..., 2]
    yb = Q[..., 1] / Q[..., 2]
    uv_b = torch.stack(
        [camera.fx * xb + camera.cx, camera.fy * yb + camera.cy],
        -1,
    )
    depth_there, is_measured = _interpolated(depth_b, uv_b[..., 0], uv_b[..., 1])
    if is_ray:
        depth_there = depth_there / (1 + xb * xb + yb * yb).sqrt()
    is_measured = is_measured & ok
    residual = ((Q[..., 2] - depth_there) / depth_there.where(is_measured, 1.0)).where(
        is_measured, 0.0
    )
    return Reprojection(uv_b, residual, is_measured)


def _interpolated(
    depth: Float[Tensor, "P H W"],
    u: Float[Tensor, "P N"],
    v: Float[Tensor, "P N"],
) -> tuple[Float[Tensor, "P N"], Bool[Tensor, "P N"]]:
    """Depth between pixel centres, bilinear in 1 / z (exact on planes); whether the four pixels are
    on one surface."""
    n, h, w = depth.shape
    x = u - 0.5
    y = v - 0.5
    is_inside = (x >= 0) & (y >= 0) & (x <= w - 1.001) & (y <= h - 1.001)
    x = x.where(is_inside, 0.0)
    y = y.where(is_inside, 0.0)
    i = x.floor().long()
    j = y.floor().long()
    fx = x - i
    fy = y - j
    at = torch.arange(n)[:, None] * (h * w) + j * w + i
    flat = depth.reshape(-1)
    corners = torch.stack([flat[at], flat[at + 1], flat[at + w], flat[at + w + 1]])
    nearest_m = corners.amin(0)
    farthest_m = corners.amax(0)
    is_inside = is_inside & (nearest_m > 0) & (farthest_m < 1.05 * nearest_m)
    inverse = 1 / corners.where(is_inside, 1.0)
    top = inverse[0] + fx * (inverse[1] - inverse[0])
    bottom = inverse[2] + fx * (inverse[3] - inverse[2])
    return 1 / (top + fy * (bottom - top)), is_inside


def greys_at(
    grey: UInt8[np.ndarray, "h w"], uv: Float[Tensor, "N 2"], width: int
) -> Float[np.ndarray, " N"]:
    """Grey levels 0..255 of a picture at pixels of another size of it, which is ``width`` pixels
    wide."""
    scale = grey.shape[1] / width
    i, j = ((uv[:, k].numpy() * scale).astype(int) for k in (0, 1))
    return grey[np.clip(j, 0, grey.shape[0] - 1), np.clip(i, 0, grey.shape[1] - 1)].astype(
        np.float64
    )


def is_usable_grey(*levels: Float[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
    """Where grey levels are neither near black nor near white in any of some pictures."""
    low, high = USABLE_GREY
    return np.logical_and.reduce([(level > low) & (level < high) for level in levels])


def gain_stops(
    a: Float[np.ndarray, " N"],
    b: Float[np.ndarray, " N"],
) -> float:
    """Brightness of the same points in the second / first picture, log2, from their usable grey
    levels."""
    return float(np.median(np.log2(b / a)))
