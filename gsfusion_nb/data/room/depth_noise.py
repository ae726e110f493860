"""Errors of depth cameras: of a Kinect, which projects a pattern, and of a stereo camera, which
compares two pictures. The truth stays known."""

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ...geometry import depth_to_normals, pixel_grid, rays
from ...types import Camera

FOCAL_BASELINE_PX_M = 580.0 * 0.075
"""Focal length (pixels of a 640-pixel-wide sensor) times baseline, as of the first Kinect:
disparity = this / depth."""

DISPARITY_STEP_PX = 1.0 / 8.0
"""Disparities are multiples of an eighth of a pixel."""

DISPARITY_SIGMA_PX = 0.06
"""With the steps' own error this gives a depth deviation near 1.6e-3 z^2 (Khoshelham & Elberink
2012: 4 cm at 5 m)."""

RANGE_M = (0.4, 5.0)
"""A Kinect measures nothing outside."""

_BASELINE_M = 0.075
_GRAZING_COS = (0.12, 0.30)
"""Below the first cosine of incidence nothing is measured, above the second everything is."""


def kinect_depth(
    depth_m: Float[Tensor, "H W"], camera: Camera, *, rng: np.random.Generator
) -> Float[Tensor, "H W"]:
    """Depth as a Kinect-like camera would measure it; 0 where it measures nothing.

    Disparity d = f b / z gets Gaussian noise and is rounded to eighths of a pixel, so that the
    error grows with z^2. Pixels at depth edges take a neighbour's depth at random. Holes: out of
    range, grazing incidence, the part hidden from the projector 7.5 cm to the right, some edge
    pixels, and a few at random.

    Args:
        depth_m: True z-depth, metres; 0 where there is none. [H, W]
        camera: Intrinsics of ``depth_m``.
        rng: Source of all randomness.

    Returns:
        Measured z-depth, metres. [H, W]

    Differentiable: no. Source: Khoshelham & Elberink 2012, "Accuracy and resolution of Kinect depth
    data".
    """
    H, W = depth_m.shape
    z = depth_m.detach().cpu().double().numpy()
    hole = _holes(depth_m, z, camera, rng)
    sigma_px = 0.5 * W / 640
    rows = np.clip(
        np.arange(H)[:, None] + np.rint(rng.normal(0, sigma_px, (H, W))).astype(int),
        0,
        H - 1,
    )
    cols = np.clip(
        np.arange(W)[None] + np.rint(rng.normal(0, sigma_px, (H, W))).astype(int),
        0,
        W - 1,
    )
    z_there = z[rows, cols]
    disparity = FOCAL_BASELINE_PX_M / np.maximum(z_there, 1e-3) + rng.normal(
        0, DISPARITY_SIGMA_PX, (H, W)
    )
    disparity = np.maximum(np.rint(disparity / DISPARITY_STEP_PX), 1) * DISPARITY_STEP_PX
    depth_measured = FOCAL_BASELINE_PX_M / disparity
    hole |= (z_there <= 0) | (depth_measured < RANGE_M[0]) | (depth_measured > RANGE_M[1])
    depth_measured[hole] = 0.0
    return torch.from_numpy(depth_measured).to(depth_m.device, depth_m.dtype)


def _holes(
    depth_m: Tensor,
    z: np.ndarray,
    camera: Camera,
    rng: np.random.Generator,
) -> np.ndarray:
    normal = depth_to_normals(camera, depth_m, max_jump=0.1)
    ray = rays(camera, pixel_grid(camera, device=depth_m.device, dtype=depth_m.dtype))
    cosine = -(normal * ray).sum(-1) / ray.norm(dim=-1)
    has_normal = (normal.abs().sum(-1) > 0).cpu().numpy()
    chance = rng.uniform(size=z.shape)
    low, high = _GRAZING_COS
    light_share = np.clip(
        (cosine.cpu().numpy() - low) / (high - low),
        0,
        1,
    )
    hole = has_normal & (chance > 0.02 + 0.98 * light_share)
    edge = ~has_normal
    edge[[0, -1], :] = edge[:, [0, -1]] = (
        False  # the image border has no normals either, but is not an edge
    )
    hole |= edge & (chance < 0.45)
    hole |= rng.uniform(size=z.shape) < 0.002
    return hole | hidden_from_the_right(z, camera, _BASELINE_M)


def hidden_from_the_right(z: np.ndarray, camera: Camera, baseline_m: float) -> np.ndarray:
    """Points whose line to a second device, ``baseline_m`` to the right, is blocked by something to
    their right in the same row.

    It sees column u at u - f b / z. It cannot see a point if a point further right is seen to the
    left of it.
    """
    column = np.arange(z.shape[1])[None] - camera.fx * baseline_m / np.maximum(z, 1e-3)
    leftmost = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    return (z > 0) & (leftmost < column - 1.0)


STEREO_WIDTH_PX = 848
"""Width of the pictures in which a D4xx camera looks for disparities."""

STEREO_BASELINE_M = 0.050
"""Between the two lenses, as of a D435."""

STEREO_SIGMA_PX = 0.08
"""Standard deviation of a disparity, pixels of the wide picture."""

STEREO_STEP_PX = 1.0 / 32.0
"""Disparities are multiples of it."""

STEREO_RANGE_M = (0.3, 6.0)
"""A stereo camera measures nothing outside."""

_WINDOW_PX = 7.0
"""Width of the patch that is compared, pixels of the wide picture."""

_TEXTURE_LEVELS = (0.8, 2.5)
"""Standard deviation of the grey levels of a patch, of 255: below the first nothing is measured,
above the second everything is."""


def stereo_depth(
    depth_m: Float[Tensor, "H W"],
    rgb_u8: UInt8[Tensor, "H W 3"],
    camera: Camera,
    *,
    rng: np.random.Generator,
) -> Float[Tensor, "H W"]:
    """Depth as a stereo camera without a projector would measure it (a RealSense D4xx); 0 where it
    measures nothing.

    A patch of ``_WINDOW_PX`` pixels is looked for in the picture of a second lens, so:
    - the error of the disparity f b / z is the same over about a patch: it makes bumps, which
      averaging neighbours does not remove; as a depth it grows with z^2;
    - a patch over a depth edge has a disparity between the two sides: flying pixels;
    - a patch without texture is found nowhere, and neither is what the second lens cannot see.

    Args:
        depth_m: True z-depth, metres; 0 where there is none. [H, W]
        rgb_u8: The picture, whose texture decides. [H, W, 3]
        camera: Intrinsics of both.
        rng: Source of all randomness.

    Returns:
        Measured z-depth, metres. [H, W]

    Differentiable: no. Source: the error is D^2 times the disparity's over (f b), as in Intel's
    "Tuning depth cameras for best performance": 1.2 cm at 2 m. The rest is a model of ours.
    """
    z = depth_m.detach().cpu().double().numpy()
    scale = z.shape[1] / STEREO_WIDTH_PX
    window_px = _WINDOW_PX * scale
    focal_baseline = camera.fx / scale * STEREO_BASELINE_M
    true_disparity = focal_baseline / np.maximum(z, 1e-3)
    disparity = _of_patches(true_disparity, window_px, rng)
    disparity += STEREO_SIGMA_PX * _bumps(z.shape, window_px, rng)
    disparity = np.rint(disparity / STEREO_STEP_PX) * STEREO_STEP_PX
    measured = focal_baseline / np.maximum(disparity, STEREO_STEP_PX)
    near_m, far_m = STEREO_RANGE_M
    hole = (z <= 0) | (measured < near_m) | (measured > far_m)
    hole |= _has_no_texture(rgb_u8, window_px, rng)
    hole |= hidden_from_the_right(z, camera, STEREO_BASELINE_M)
    measured[hole] = 0.0
    return torch.from_numpy(measured).to(depth_m.device, depth_m.dtype)


def _of_patches(disparity: np.ndarray, window_px: float, rng: np.random.Generator) -> np.ndarray:
    """The disparity that a patch has: that of its middle, and across a depth edge one between the
    two sides, each share as likely."""
    size = max(3, 2 * round(window_px / 2) + 1)
    block = np.ones((size, size), np.uint8)
    nearest = cv2.dilate(disparity, block)
    farthest = cv2.erode(disparity, block)
    is_edge = nearest - farthest > 1.0
    share = rng.uniform(size=disparity.shape)
    is_mixed = is_edge & (rng.uniform(size=disparity.shape) < 0.3)
    between = farthest + share * (nearest - farthest)
    return np.where(is_mixed, between, disparity)


def _bumps(shape: tuple[int, ...], window_px: float, rng: np.random.Generator) -> np.ndarray:
    """Normal noise that is equal over about a patch; standard deviation 1."""
    sigma_px = max(window_px / 3, 1e-3)
    noise = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), sigma_px)
    return noise / noise.std()


def _has_no_texture(rgb_u8: Tensor, window_px: float, rng: np.random.Generator) -> np.ndarray:
    grey = cv2.cvtColor(rgb_u8.cpu().numpy(), cv2.COLOR_RGB2GRAY).astype(np.float64)
    size = max(3, 2 * round(window_px / 2) + 1)
    mean = cv2.blur(grey, (size, size))
    variance = cv2.blur(grey**2, (size, size)) - mean**2
    deviation = np.sqrt(np.maximum(variance, 0))
    low, high = _TEXTURE_LEVELS
    chance = np.clip((deviation - low) / (high - low), 0, 1)
    return rng.uniform(size=grey.shape) > chance
