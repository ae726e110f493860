"""What a camera sees of the Gaussian map."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderOutput:
    """What a camera sees of the Gaussian map, or B cameras do, each in its own picture."""

    rgb: Float[Tensor, "*B H W 3"]
    """Blended colour over the background, black by default; not clamped."""
    depth_m: Float[Tensor, "*B H W"]
    """Blended z-depth, sum of w_k z_k: not divided by alpha, so 0 where nothing is."""
    alpha: Float[Tensor, "*B H W"]
    """Accumulated opacity, 1 - transmittance."""
    first_index: Int[Tensor, "*B H W"] | None
    """Row of the nearest Gaussian that contributes at the pixel; -1 where none does. ``None`` if
    not asked for."""
    dominant_index: Int[Tensor, "*B H W"] | None
    """Row of the Gaussian with the largest weight at the pixel; -1 where none has any. ``None`` if
    not asked for."""
    hit_index: Int[Tensor, "*B H W"] | None = None
    """Row of the nearest Gaussian that is opaque at the pixel, blended or not, or -1. ``None`` if
    not asked for."""
    surface_depth_m: Float[Tensor, "*B H W"] | None = None
    """z-depth of the surface, metres, 0 where there is none; only for maps that have a surface
    (RTG-SLAM's discs)."""
    features: Float[Tensor, "*B H W F"] | None = None
    """Blended features, sum of w_k f_k. ``None`` if none were given."""

    def to(self, device: torch.device | str) -> "RenderOutput":
        """The same images on ``device``."""
        moved = {name: x.to(device) for name, x in vars(self).items() if x is not None}
        return dataclasses.replace(self, **moved)
