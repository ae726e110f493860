"""A coloured triangle mesh."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..errors import ArgumentError


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """A coloured triangle mesh with shared vertices.

    Raises:
        ValueError: a face of a vertex that is not there.
    """

    vertices_W: Float[Tensor, "V 3"]
    """Positions, world frame, metres."""
    faces: Int[Tensor, "F 3"]
    """Vertex indices, counter-clockwise seen from the free side."""
    rgb: Float[Tensor, "V 3"]
    """Vertex colours, 0..1."""

    def __post_init__(self):
        if not self.faces.numel():
            return
        low, high = torch.stack(torch.aminmax(self.faces)).tolist()
        if low < 0 or high >= len(self.vertices_W):
            raise ArgumentError(
                f"faces must refer to vertices 0 to {len(self.vertices_W) - 1}, got {low} to {high}"
            )
