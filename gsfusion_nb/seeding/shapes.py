"""Sizes of seeds: as large as the distance to their neighbours, or as if they were farther away."""

import dataclasses
from typing import Literal

import torch

from ..types import Seeds
from .context import SeedContext

MIN_SPACING_M = 1e-7**0.5
"""Smallest size, metres: Kerbl et al. 2023 limit the mean squared distance to 1e-7 from below
(released code)."""


def sized_by_neighbours(
    ctx: SeedContext,
    seeds: Seeds,
    among: Literal["new", "new and map"] = "new",
    *,
    factor: float = 1.0,
    max_of_mean: float = torch.inf,
) -> Seeds:
    """The same seeds, round, each as large as the root mean square distance to its 3 nearest
    neighbours.

    Args:
        ctx: The map.
        seeds: New Gaussians; one without any neighbour keeps its size.
        among: Whether the Gaussians of the map count as neighbours.
        factor: Multiplies the distance.
        max_of_mean: Largest standard deviation as a multiple of the mean of all.

    Source: Kerbl et al. 2023 (3DGS). The paper takes the mean of the distances, the released code
    the root of the mean of their squares.
    """
    if len(seeds) == 0:
        return seeds
    spacing = ctx.nearest(seeds.xyz_W, 3, among).spacing_m.clamp_min(MIN_SPACING_M)
    size = torch.where(
        spacing.isnan(),
        seeds.scale_m[:, 0],
        factor * spacing,
    )
    size = size.clamp(max=max_of_mean * float(size.mean()))
    return dataclasses.replace(
        seeds,
        scale_m=size[:, None].expand(-1, 3).clone(),
    )


def pushed_back(ctx: SeedContext, seeds: Seeds, factor: float) -> Seeds:
    """The same seeds as if the depth had been ``factor`` times as large: farther from the camera,
    and larger."""
    eye = ctx.frame.T_WC[:3, 3]
    return dataclasses.replace(
        seeds, xyz_W=eye + factor * (seeds.xyz_W - eye), scale_m=factor * seeds.scale_m
    )
