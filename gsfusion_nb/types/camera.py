"""A pinhole camera: image size and intrinsics."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_number, check_positive
from ..errors import ArgumentError

MAX_SIDE_PX = 1 << 16


MAX_PIXELS = 1 << 27
"""Larger images would not fit into memory, and into the 32-bit numbers that kernels count pixels
with."""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A pinhole camera without distortion. Pixel (i, j) has its centre at (i + 0.5, j + 0.5)."""

    width: int
    """Image width, pixels."""
    height: int
    """Image height, pixels."""
    fx: float
    """Focal length along x, pixels."""
    fy: float
    """Focal length along y, pixels."""
    cx: float
    """Principal point, x, in pixel-edge coordinates (width / 2 is the image centre)."""
    cy: float
    """Principal point, y, in pixel-edge coordinates."""

    def __post_init__(self):
        for name in ("width", "height", "fx", "fy"):
            check_positive(f"camera {name}", getattr(self, name))
        for name in ("cx", "cy"):
            check_number(f"camera {name}", getattr(self, name))
        if not all(isinstance(n, int) and n <= MAX_SIDE_PX for n in (self.width, self.height)):
            raise ArgumentError(
                f"camera width and height must be whole numbers up to {MAX_SIDE_PX}, got "
                f"{self.width} x {self.height}"
            )
        if self.width * self.height > MAX_PIXELS:
            raise ArgumentError(
                f"an image may have {MAX_PIXELS} pixels, got {self.width} x {self.height}"
            )

    @property
    def K(self) -> Float[Tensor, "3 3"]:
        """Intrinsic matrix, float64."""
        return torch.tensor(
            [[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]],
            dtype=torch.float64,
        )

    def resized(self, width: int, height: int) -> "Camera":
        """The same view on another pixel grid (edges stay edges, so the principal point scales
        without a shift)."""
        sx = width / self.width
        sy = height / self.height
        return Camera(
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )
