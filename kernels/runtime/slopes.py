"""Directions of the rays through the pixel centres, as one number per column and one per row."""

import torch
from torch import Tensor

from gsfusion_nb.types import Camera


def ray_slopes(camera: Camera) -> tuple[Tensor, Tensor]:
    """x / z of every column [W] and y / z of every row [H] of pixels, float32."""
    x = (torch.arange(camera.width, dtype=torch.float32) + (0.5 - camera.cx)) / camera.fx
    y = (torch.arange(camera.height, dtype=torch.float32) + (0.5 - camera.cy)) / camera.fy
    return x, y
