"""A frame on another pixel grid."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from ...types import Camera, Frame


def resize_frame(frame: Frame, camera: Camera) -> Frame:
    """The same view with the pixel grid of ``camera`` (``frame.camera.resized(width, height)``).

    Colour is averaged over the area that a new pixel covers (interpolated linearly when enlarging). Depth is taken from
    the nearest source pixel and never interpolated, because a mean across a depth edge is a point on neither surface.
    An 8-bit image stays 8-bit, with rounding.

    Differentiable: no.
    """
    if (camera.width, camera.height) == (frame.camera.width, frame.camera.height):
        return dataclasses.replace(frame, camera=camera)
    return dataclasses.replace(
        frame,
        rgb=_resize_rgb(frame.colour, camera.width, camera.height),
        depth_m=_resize_depth(frame.depth_m, camera.width, camera.height),
        camera=camera,
    )


def nearest_source(size: int, source_size: int) -> Int[Tensor, " S"]:
    """Source pixel whose centre is nearest to that of each of ``size`` new pixels; the lower one of two equals. [S]

    The centre of new pixel i lies at (i + 0.5) source_size / size. At half the size these are pixels 0, 2, 4, ..., half
    a source pixel off, which no choice avoids; at a third they are 1, 4, 7, ..., which is exact.
    """
    numerator = (2 * torch.arange(size) + 1) * source_size
    return -(-numerator // (2 * size)) - 1


def resize_colour(rgb: np.ndarray, width: int, height: int) -> np.ndarray:
    """Colour averaged over the area that a new pixel covers, or interpolated linearly when enlarged. [h, w, 3]"""
    import cv2

    if rgb.shape[1::-1] == (width, height):
        return rgb
    shrinks = width <= rgb.shape[1] and height <= rgb.shape[0]
    return cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def _resize_rgb(rgb: Shaped[Tensor, "H W 3"], width: int, height: int) -> Shaped[Tensor, "h w 3"]:
    return torch.from_numpy(resize_colour(rgb.cpu().numpy(), width, height)).to(rgb.device)


def _resize_depth(depth_m: Float[Tensor, "H W"], width: int, height: int) -> Float[Tensor, "h w"]:
    rows = nearest_source(height, depth_m.shape[0]).to(depth_m.device)
    columns = nearest_source(width, depth_m.shape[1]).to(depth_m.device)
    return depth_m[rows][:, columns]
