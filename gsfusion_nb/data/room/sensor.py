"""Errors of a structured-light depth camera: disparity noise and steps, irregular edges, projector shadow, holes."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...geometry import depth_to_normals, pixel_grid, rays
from ...types import Camera

FOCAL_BASELINE_PX_M = 580.0 * 0.075
"""Focal length (pixels of a 640-pixel-wide sensor) times baseline, as of the first Kinect: disparity = this / depth."""

DISPARITY_STEP_PX = 1.0 / 8.0
"""Disparities are multiples of an eighth of a pixel."""

DISPARITY_SIGMA_PX = 0.06
"""With the steps' own error this gives a depth deviation near 1.6e-3 z^2 (Khoshelham & Elberink 2012: 4 cm at 5 m)."""

RANGE_M = (0.4, 5.0)
"""Nothing is measured outside."""

_BASELINE_M = 0.075
_GRAZING_COS = (0.12, 0.30)
"""Below the first cosine of incidence nothing is measured, above the second everything is."""


def kinect_depth(depth_m: Float[Tensor, "H W"], camera: Camera, *, rng: np.random.Generator) -> Float[Tensor, "H W"]:
    """Depth as a Kinect-like camera would measure it; 0 where it measures nothing.

    Disparity d = f b / z gets Gaussian noise and is rounded to eighths of a pixel, so that the error grows with z^2.
    Pixels at depth edges take a neighbour's depth at random. Holes: out of range, grazing incidence, the part hidden
    from the projector 7.5 cm to the right, some edge pixels, and a few at random.

    Args:
        depth_m: True z-depth, metres; 0 where there is none. [H, W]
        camera: Intrinsics of ``depth_m``.
        rng: Source of all randomness.

    Returns:
        Measured z-depth, metres. [H, W]

    Differentiable: no. Source: Khoshelham & Elberink 2012, "Accuracy and resolution of Kinect depth data".
    """
    H, W = depth_m.shape
    z = depth_m.detach().cpu().double().numpy()
    hole = _holes(depth_m, z, camera, rng)
    sigma_px = 0.5 * W / 640
    rows = np.clip(np.arange(H)[:, None] + np.rint(rng.normal(0, sigma_px, (H, W))).astype(int), 0, H - 1)
    cols = np.clip(np.arange(W)[None] + np.rint(rng.normal(0, sigma_px, (H, W))).astype(int), 0, W - 1)
    seen = z[rows, cols]
    disparity = FOCAL_BASELINE_PX_M / np.maximum(seen, 1e-3) + rng.normal(0, DISPARITY_SIGMA_PX, (H, W))
    disparity = np.maximum(np.rint(disparity / DISPARITY_STEP_PX), 1) * DISPARITY_STEP_PX
    measured = FOCAL_BASELINE_PX_M / disparity
    hole |= (seen <= 0) | (measured < RANGE_M[0]) | (measured > RANGE_M[1])
    measured[hole] = 0.0
    return torch.from_numpy(measured).to(depth_m.device, depth_m.dtype)


def _holes(depth_m: Tensor, z: np.ndarray, camera: Camera, rng: np.random.Generator) -> np.ndarray:
    normal = depth_to_normals(camera, depth_m, max_jump=0.1)
    ray = rays(camera, pixel_grid(camera, device=depth_m.device, dtype=depth_m.dtype))
    cosine = -(normal * ray).sum(-1) / ray.norm(dim=-1)
    known = (normal.abs().sum(-1) > 0).cpu().numpy()
    chance = rng.uniform(size=z.shape)
    low, high = _GRAZING_COS
    returned = np.clip((cosine.cpu().numpy() - low) / (high - low), 0, 1)
    hole = known & (chance > 0.02 + 0.98 * returned)
    edge = ~known
    edge[[0, -1], :] = edge[:, [0, -1]] = False  # the image border has no normals either, but is not an edge
    hole |= edge & (chance < 0.45)
    hole |= rng.uniform(size=z.shape) < 0.002
    return hole | _projector_shadow(z, camera)


def _projector_shadow(z: np.ndarray, camera: Camera) -> np.ndarray:
    """Points whose line to the projector is blocked by something to their right in the same row.

    The projector sees column u at u - f b / z. It cannot see a point if a point further right is projected to the left
    of it.
    """
    column = np.arange(z.shape[1])[None] - camera.fx * _BASELINE_M / np.maximum(z, 1e-3)
    leftmost = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    return (z > 0) & (leftmost < column - 1.0)
