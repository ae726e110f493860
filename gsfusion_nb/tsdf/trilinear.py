"""Trilinear interpolation between the eight corners of a cell: the weights and their derivatives."""

import functools

import torch
from jaxtyping import Float, Int
from torch import Tensor

CORNERS = torch.tensor([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)])
"""Corner c = x + 2 y + 4 z of a unit cube. [8, 3]"""


@functools.cache
def corners(device: torch.device) -> Int[Tensor, "8 3"]:
    """``CORNERS`` on a device; copied there once, because a GPU is waited for."""
    return CORNERS.to(device)


def corner_weights(f: Float[Tensor, "N 3"]) -> Float[Tensor, "N 8"]:
    """Trilinear weights of the corners of a cell, at fractions ``f`` along its edges: products of f or 1 - f."""
    return torch.where(corners(f.device) == 1, f[:, None], 1.0 - f[:, None]).prod(2)


def corner_gradients(f: Float[Tensor, "N 3"]) -> Float[Tensor, "N 8 3"]:
    """Derivatives of ``corner_weights`` along the three axes: plus or minus the product over the other two axes."""
    upper = corners(f.device) == 1
    along = torch.where(upper, f[:, None], 1.0 - f[:, None])
    others = along[..., [[1, 2], [0, 2], [0, 1]]].prod(3)
    return torch.where(upper, others, -others)
