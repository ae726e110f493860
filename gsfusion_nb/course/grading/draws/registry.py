"""The table of the draws, and random values of which they are made."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ....geometry import se3
from ....types import Camera

Draw = Callable[[torch.Generator], tuple[Any, ...]]

DRAWS: dict[str, Draw] = {}
"""Exercise -> a function that draws the arguments of one call."""
F64 = torch.float64


def drawn(exercise: str) -> Callable[[Draw], Draw]:
    """Register the decorated function for ``exercise``."""

    def register(function: Draw) -> Draw:
        DRAWS[exercise] = function
        return function

    return register


def whole(g: torch.Generator, low: int, high: int) -> int:
    """A whole number from low to high, both included."""
    return int(torch.randint(low, high + 1, (), generator=g))


def number(g: torch.Generator, low: float | int, high: float | int) -> float:
    """A number between two."""
    return low + (high - low) * float(torch.rand((), generator=g, dtype=F64))


def numbers(
    g: torch.Generator, low: float | int, high: float | int, *shape: int, dtype: torch.dtype = torch.float32
) -> Tensor:
    """A tensor of numbers between two."""
    return low + (high - low) * torch.rand(*shape, generator=g, dtype=dtype)


def normal(g: torch.Generator, *shape: int) -> Tensor:
    """A float64 tensor of normally distributed numbers."""
    return torch.randn(*shape, generator=g, dtype=F64)


def pose(g: torch.Generator, dtype: torch.dtype = F64, size: float | int = 1.0) -> Tensor:
    """A pose in general position."""
    return se3.exp(size * numbers(g, -0.8, 0.8, 6, dtype=F64)).to(dtype)


def camera(g: torch.Generator, width: int = 40, height: int = 30) -> Camera:
    """A camera with two focal lengths, and its principal point off the middle."""
    fx, fy = number(g, 0.8 * width, 1.2 * width), number(g, 0.8 * width, 1.2 * width)
    cx, cy = number(g, 0.45 * width, 0.55 * width), number(g, 0.45 * height, 0.55 * height)
    return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
