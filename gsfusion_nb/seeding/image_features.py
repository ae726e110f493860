"""What a seeding rule may look for in the frame's picture: edges, corners, detail."""

import math
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from ..constants import LUMA_WEIGHTS
from ..types import Frame

SMALLEST_LEVEL_PX, BORDER_PX = 8, 4
"""Corners are looked for on image sizes down to this many pixels, and not closer to the border than this."""


class ImageFeatures:
    """The part of ``SeedContext`` that reads the picture; each result is computed once."""

    frame: Frame

    def grey(self) -> Float[Tensor, "H W"]:
        """Brightness of the picture, 0..1: 0.2989 R + 0.587 G + 0.114 B. [H, W]"""
        return self._once("grey", lambda: luma(self.frame.rgb))

    def gradient(self) -> Float[Tensor, "H W"]:
        """Length of the gradient of the brightness, per pixel (central differences; one-sided at the border). [H, W]"""
        return self._once("gradient", lambda: gradient_length(self.grey()))

    def laplacian(self) -> Float[Tensor, "H W"]:
        """Sum over R, G, B of the absolute Laplacian (four neighbours), 0..12: the fine detail. [H, W]"""
        return self._once("laplacian", lambda: absolute_laplacian(self.frame.rgb))

    def edges(self, low: float = 100.0, high: float = 200.0, dilate_px: int = 1) -> Bool[Tensor, "H W"]:
        """Pixels on edges (Canny 1986, as in OpenCV).

        Args:
            low, high: Thresholds of the hysteresis, for the gradient of grey levels 0..255.
            dilate_px: Edges are made this many pixels wide; 1 leaves them as they are.

        Returns:
            A mask. [H, W]
        """
        return self._once(("edges", low, high, dilate_px), lambda: canny(self.frame, low, high, dilate_px))

    def corners(self, count: int = 1000, method: Literal["orb", "shi_tomasi"] = "orb") -> Float[Tensor, "K 2"]:
        """Positions of the strongest corners, continuous pixel coordinates, at centres of pixels; none in an image with
        a side below 8 pixels. [K, 2]

        Args:
            count: At most this many.
            method: "orb": FAST corners on eight image sizes, by their Harris score, as ORB takes them (OpenCV, about
                6 ms at 320x240); "shi_tomasi": the smaller eigenvalue of the structure tensor, largest within 5 x 5
                pixels (kornia, about 20 ms; on the frame's device).

        Source: Rublee et al. 2011; Shi and Tomasi 1994.
        """
        if min(self.frame.camera.width, self.frame.camera.height) < SMALLEST_LEVEL_PX:
            return self.frame.depth_m.new_zeros(0, 2)
        find = orb_corners if method == "orb" else shi_tomasi_corners
        return self._once(("corners", count, method), lambda: find(self.frame, count))

    def _once(self, key: Any, make: Any) -> Any:
        raise NotImplementedError


def luma(rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Brightness 0..1 of a picture."""
    return rgb @ rgb.new_tensor(LUMA_WEIGHTS)


def gradient_length(grey: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Length of the gradient, per pixel; along an axis of one pixel it is 0. Differentiable: no."""
    axes = [d for d in (0, 1) if grey.shape[d] > 1]
    if not axes:
        return torch.zeros_like(grey)
    return torch.stack(torch.gradient(grey, dim=axes)).norm(dim=0)


def absolute_laplacian(rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """|4 x - its four neighbours|, summed over the channels; pixels outside the picture equal those at its border."""
    channels = rgb.permute(2, 0, 1)[:, None]
    padded = functional.pad(channels, (1, 1, 1, 1), mode="replicate")
    kernel = rgb.new_tensor([[0.0, 1.0, 0.0], [1.0, -4.0, 1.0], [0.0, 1.0, 0.0]])
    return functional.conv2d(padded, kernel[None, None]).abs().sum(dim=(0, 1))


def disc_blur(image: Float[Tensor, "H W"], radius_px: float) -> Float[Tensor, "H W"]:
    """Mean over the pixels whose centre is within ``radius_px``; outside the picture its border is repeated."""
    reach = int(radius_px)
    offset = torch.arange(-reach, reach + 1, device=image.device)
    disc = (offset[:, None] ** 2 + offset[None, :] ** 2 <= radius_px**2).to(image)
    padded = functional.pad(image[None, None], (reach,) * 4, mode="replicate")
    return functional.conv2d(padded, (disc / disc.sum())[None, None])[0, 0]


def canny(frame: Frame, low: float, high: float, dilate_px: int) -> Bool[Tensor, "H W"]:
    """OpenCV's Canny edges of the frame's grey image, widened. On the frame's device; differentiable: no."""
    import cv2

    edges = cv2.Canny(_grey_levels(frame), low, high)
    if dilate_px > 1:
        edges = cv2.dilate(edges, np.ones((dilate_px, dilate_px), np.uint8))
    return torch.from_numpy(edges > 0).to(frame.depth_m.device)


def orb_corners(frame: Frame, count: int) -> Float[Tensor, "K 2"]:
    """Centres of the pixels in which ORB's detector finds a corner, each pixel once, row by row. Unlike ORB's own
    defaults, corners near the border count, since no descriptors are computed."""
    import cv2

    side = min(frame.camera.width, frame.camera.height)
    levels = min(8, 1 + int(math.log(side / SMALLEST_LEVEL_PX, 1.2)))
    orb = cv2.ORB.create(nfeatures=count, scaleFactor=1.2, nlevels=levels, edgeThreshold=BORDER_PX)
    found = cv2.KeyPoint.convert(orb.detect(_grey_levels(frame), None))
    position = torch.from_numpy(np.array(found, np.float32).reshape(-1, 2))
    pixel = torch.unique(position.round().long().flip(1), dim=0).flip(1)  # OpenCV counts centres as whole numbers
    return (pixel.float() + 0.5).to(frame.depth_m.device)


def shi_tomasi_corners(frame: Frame, count: int) -> Float[Tensor, "K 2"]:
    """Centres of the pixels with the largest response that are the largest of their 5 x 5 neighbourhood."""
    from kornia.feature import gftt_response

    response = gftt_response(luma(frame.rgb)[None, None])[0, 0]
    largest = functional.max_pool2d(response[None, None], 5, stride=1, padding=2)[0, 0]
    peaks = torch.where((response == largest) & (response > 1e-6), response, 0.0).flatten()
    order = peaks.argsort(descending=True, stable=True)[:count]
    pixel = order[peaks[order] > 0].sort().values
    row, column = pixel // frame.camera.width, pixel % frame.camera.width
    return torch.stack([column, row], dim=1).to(response) + 0.5


def _grey_levels(frame: Frame) -> np.ndarray:
    import cv2

    return cv2.cvtColor(frame.rgb_u8.cpu().numpy(), cv2.COLOR_RGB2GRAY)
