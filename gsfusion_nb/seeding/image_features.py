"""Edges, corners and detail of a picture."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from ..errors import ArgumentError
from ..types import Frame
from .quadtree import LUMA_WEIGHTS

NO_GRADIENT = 0.01
"""Gradients of the brightness well below this are noise, per pixel."""
SMALLEST_LEVEL_PX = 8
BORDER_PX = 4
"""Corners are looked for on image sizes down to this many pixels, and not closer to the border than
this."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EdgeDirection:
    """The direction in which brightness changes least."""

    direction: Float[Tensor, "H W 2"]
    """Unit vector along the edge in the image (u, v); its sign is arbitrary."""
    coherence: Float[Tensor, "H W"]
    """(l1 - l2) / (l1 + l2) of the eigenvalues l1 >= l2 of the tensor: 1 at a straight edge, 0
    where no direction differs from the others."""


def luma(rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Brightness of a picture, 0..1: 0.2989 R + 0.587 G + 0.114 B."""
    return rgb @ rgb.new_tensor(LUMA_WEIGHTS)


def gradient_length(grey: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Length of the gradient of a brightness, per pixel (central differences; one-sided at the
    border); along an axis of one pixel it is 0. Differentiable: no."""
    return torch.stack(gradients(grey)).norm(dim=0)


def gradients(grey: Float[Tensor, "H W"]) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """Derivatives along u and along v, per pixel (central differences; one-sided at the border); 0
    along an axis of one pixel. Differentiable: no."""
    gv, gu = (
        torch.gradient(grey, dim=d)[0] if grey.shape[d] > 1 else torch.zeros_like(grey)
        for d in (0, 1)
    )
    return gu, gv


def structure_directions(grey: Float[Tensor, "H W"], window_px: int) -> EdgeDirection:
    """How edges run through each pixel, and how clearly, by eigenvectors of the structure tensor.

    The tensor is the mean of (gx, gy)^T (gx, gy) over a window (Foerstner and Guelch 1987). A
    gradient of less than about 1/100 per pixel counts as none. Differentiable: no.

    Args:
        grey: Brightness.
        window_px: Odd side of the square over which the tensor is averaged.

    Raises:
        ValueError: ``window_px`` is even or below 1.
    """
    if window_px < 1 or window_px % 2 == 0:
        raise ArgumentError(f"window_px must be odd and at least 1, got {window_px}")
    gx, gy = gradients(grey)
    xx, yy, xy = box_blur(
        torch.stack([gx * gx, gy * gy, gx * gy], dim=2),
        window_px,
    ).unbind(2)
    difference = ((xx - yy).square() + 4 * xy.square()).sqrt()  # l1 - l2
    gradient_angle = torch.atan2(2 * xy, xx - yy) / 2
    return EdgeDirection(
        direction=torch.stack([-gradient_angle.sin(), gradient_angle.cos()], dim=2),
        coherence=difference / (xx + yy + NO_GRADIENT**2),
    )


def box_blur(image: Float[Tensor, "H W C"], window_px: int) -> Float[Tensor, "H W C"]:
    """Mean over a square window of odd side; outside the picture its border is repeated."""
    reach = window_px // 2
    margin_image = functional.pad(
        image.permute(2, 0, 1)[None],
        (reach,) * 4,
        mode="replicate",
    )
    return functional.avg_pool2d(margin_image, window_px, stride=1)[0].permute(1, 2, 0)


def absolute_laplacian(rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """The fine detail, 0..12: |4 x - its four neighbours|, summed over the channels; pixels outside
    the picture equal those at its border."""
    channels = rgb.permute(2, 0, 1)[:, None]
    margin_image = functional.pad(channels, (1, 1, 1, 1), mode="replicate")
    kernel = rgb.new_tensor([[0.0, 1.0, 0.0], [1.0, -4.0, 1.0], [0.0, 1.0, 0.0]])
    return functional.conv2d(margin_image, kernel[None, None]).abs().sum(dim=(0, 1))


def without_detail(rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """The picture at half the size (means of 2 x 2 pixels), enlarged again (bilinear): without its
    finest detail."""
    H, W, _ = rgb.shape
    channels = rgb.permute(2, 0, 1)[None]
    small = functional.interpolate(
        channels,
        size=(-(-H // 2), -(-W // 2)),
        mode="area",
    )
    return functional.interpolate(small, size=(H, W), mode="bilinear")[0].permute(1, 2, 0)


def disc_blur(image: Float[Tensor, "H W"], radius_px: float) -> Float[Tensor, "H W"]:
    """Mean over the pixels whose centre is within ``radius_px``; outside the picture its border is
    repeated."""
    reach = int(radius_px)
    offset = torch.arange(-reach, reach + 1, device=image.device)
    disc = (offset[:, None] ** 2 + offset[None, :] ** 2 <= radius_px**2).to(image)
    margin_image = functional.pad(image[None, None], (reach,) * 4, mode="replicate")
    return functional.conv2d(margin_image, (disc / disc.sum())[None, None])[0, 0]


def canny(
    frame: Frame, low: float, high: float, dilate_px: int, euclidean: bool = False
) -> Bool[Tensor, "H W"]:
    """OpenCV's Canny edges of the frame's grey image, widened. On the frame's device;
    differentiable: no."""
    edges = cv2.Canny(_grey_levels(frame), low, high, L2gradient=euclidean)
    if dilate_px > 1:
        edges = cv2.dilate(edges, np.ones((dilate_px, dilate_px), np.uint8))
    return torch.from_numpy(edges > 0).to(frame.depth_m.device)


def orb_corners(frame: Frame, count: int) -> Float[Tensor, "K 2"]:
    """Positions of the strongest corners, at most ``count``, continuous pixel coordinates, at
    centres of pixels, each pixel once, row by row; none in an image with a side below 8 pixels.

    FAST corners on eight image sizes, by their Harris score, as ORB takes them (OpenCV, about 6 ms
    at 320x240). Unlike with ORB's own defaults, corners near the border count, since no descriptors
    are computed. Source: Rublee et al. 2011.
    """
    side = min(frame.camera.width, frame.camera.height)
    if side < SMALLEST_LEVEL_PX:
        return frame.depth_m.new_zeros(0, 2)
    levels = min(8, 1 + int(math.log(side / SMALLEST_LEVEL_PX, 1.2)))
    orb = cv2.ORB.create(nfeatures=count, scaleFactor=1.2, nlevels=levels, edgeThreshold=BORDER_PX)
    corners = cv2.KeyPoint.convert(orb.detect(_grey_levels(frame), None))
    position = torch.from_numpy(np.array(corners, np.float32).reshape(-1, 2))
    # OpenCV counts centres as whole numbers
    pixel = torch.unique(position.round().long().flip(1), dim=0).flip(1)
    return (pixel.float() + 0.5).to(frame.depth_m.device)


def _grey_levels(frame: Frame) -> np.ndarray:
    return cv2.cvtColor(frame.rgb_u8.cpu().numpy(), cv2.COLOR_RGB2GRAY)
