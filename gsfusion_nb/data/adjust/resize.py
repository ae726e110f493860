"""A frame on another pixel grid."""

import dataclasses

import cv2
import numpy as np
import torch
from jaxtyping import Int, Shaped
from torch import Tensor

from ...types import Camera, Frame


def resize_frame(frame: Frame, camera: Camera) -> Frame:
    """The same view with the pixel grid of ``camera`` (``frame.camera.resized(width, height)``).

    Colour is averaged over the area that a new pixel covers (interpolated linearly when enlarging).
    Depth is taken from the nearest source pixel and never interpolated, because a mean across a
    depth edge is a point on neither surface. An 8-bit image stays 8-bit, with rounding.
    ``frame.extra`` comes from the nearest source pixel, as depth does.

    Differentiable: no.
    """
    if camera == frame.camera:
        return frame
    if (camera.width, camera.height) == (frame.camera.width, frame.camera.height):
        return dataclasses.replace(frame, camera=camera)
    rgb = resize_colour(frame.colour.cpu().numpy(), camera.width, camera.height)
    return dataclasses.replace(
        frame,
        rgb=torch.from_numpy(rgb).to(frame.colour.device),
        depth_m=_resize_nearest(frame.depth_m, camera.width, camera.height),
        extra={
            name: _resize_nearest(image, camera.width, camera.height)
            for name, image in frame.extra.items()
        },
        camera=camera,
    )


def resized_camera(camera: Camera, width: int, height: int) -> Camera:
    """Camera at the requested size, pixels; 0 keeps the proportions, and two zeros keep the
    size."""
    if not width and not height:
        return camera
    width = width or max(1, round(camera.width * height / camera.height))
    height = height or max(1, round(camera.height * width / camera.width))
    return camera.resized(width, height)


def nearest_source(size: int, source_size: int) -> Int[Tensor, " S"]:
    """Source pixel whose centre is nearest to that of each of ``size`` new pixels; the lower one of
    two equals. [S]

    The centre of new pixel i lies at (i + 0.5) source_size / size. At half the size these are
    pixels 0, 2, 4, ..., half a source pixel off, which no choice avoids; at a third they are 1, 4,
    7, ..., which is exact.
    """
    numerator = (2 * torch.arange(size) + 1) * source_size
    return -(-numerator // (2 * size)) - 1


def resize_colour(rgb: np.ndarray, width: int, height: int) -> np.ndarray:
    """Colour averaged over the area that a new pixel covers, or interpolated linearly when
    enlarged. [h, w, ...]"""
    if rgb.shape[1::-1] == (width, height):
        return rgb
    shrinks = width <= rgb.shape[1] and height <= rgb.shape[0]
    return cv2.resize(
        rgb, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    )


def _resize_nearest(
    image: Shaped[Tensor, "H W *C"], width: int, height: int
) -> Shaped[Tensor, "h w *C"]:
    rows = nearest_source(height, image.shape[0]).to(image.device)
    columns = nearest_source(width, image.shape[1]).to(image.device)
    return image[rows][:, columns]
