"""NumPy arrays as the tensors of a frame: what has one meaning is converted, the rest is refused.

A tensor is a copy of its array, so a camera may fill the array again.
"""

import numpy as np
import torch
from torch import Tensor

from .errors import ArgumentError

MAX_COLOUR = 1.001
"""Floats above it are not colours in 0..1: they are grey levels, or have another scale."""


def colour_tensor(name: str, rgb: np.ndarray) -> Tensor:
    """Colours as a tensor: bytes stay bytes, floats of any length become float32.

    Args:
        name: What errors call the image.
        rgb: Red, green, blue: uint8 in 0..255, or floats in 0..1. [H, W, 3]

    Raises:
        ValueError: whole numbers of another type, or floats above 1: their scale is not known.
    """
    if rgb.dtype == np.uint8:
        return torch.from_numpy(rgb.copy(order="C"))
    if not np.issubdtype(rgb.dtype, np.floating):
        raise ArgumentError(
            f"{name} must be uint8 (0..255) or float (0..1), got a numpy.ndarray of {rgb.dtype}, "
            "whose scale is not known; convert it with .astype(np.uint8), or divide it by its "
            "largest possible value"
        )
    largest = float(rgb.max()) if rgb.size else 0.0  # NaN of an image with a NaN
    if largest > MAX_COLOUR:
        raise ArgumentError(
            f"{name} of floats must be in 0..1, got values up to {largest:g}; grey levels 0..255 "
            "must be uint8: convert them with .astype(np.uint8)"
        )
    return _float32(rgb)


def depth_tensor(name: str, depth_m: np.ndarray) -> Tensor:
    """Depth in metres as a float32 tensor.

    Args:
        name: What errors call the image.
        depth_m: Depth, metres, as floats. [H, W]

    Raises:
        ValueError: whole numbers, as depth cameras give them: their unit is not known.
    """
    if not np.issubdtype(depth_m.dtype, np.floating):
        raise ArgumentError(
            f"{name} must be float, in metres, got a numpy.ndarray of {depth_m.dtype}, whose unit "
            "is not known; divide it by the camera's units in a metre, such as depth / 1000.0 for "
            "millimetres"
        )
    return _float32(depth_m)


def pose_tensor(name: str, T: np.ndarray) -> Tensor:
    """A pose as a float32 tensor; raises ``ValueError`` for an array that does not hold real
    numbers."""
    if not np.issubdtype(T.dtype, np.floating) and not np.issubdtype(T.dtype, np.integer):
        raise ArgumentError(f"{name} must hold numbers, got a numpy.ndarray of {T.dtype}")
    return _float32(T)


def _float32(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.array(values, dtype=np.float32, order="C"))
