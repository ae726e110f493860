"""Sizes and shapes of seeds: as large as the distance to their neighbours, discs along a normal."""

import dataclasses
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import quaternion
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


def as_discs(
    ctx: SeedContext, seeds: Seeds, normal_W: Float[Tensor, "N 3"], thickness: float
) -> Seeds:
    """The same seeds, thin along their normals: standard deviations (s, s, thickness s), the z axis
    along the normal.

    Args:
        ctx: The frame, for its camera's position.
        seeds: Round Gaussians.
        normal_W: Normals, world frame; where one is zero, the disc faces the camera. [N, 3]
        thickness: Smallest standard deviation as a share of the others. Flat Gaussians (2DGS) have
            no third one; the renderer here needs one.
    """
    to_camera = ctx.frame.T_WC[:3, 3] - seeds.xyz_W
    axis = torch.where(
        (normal_W != 0).any(dim=1, keepdim=True),
        normal_W,
        to_camera,
    )
    return dataclasses.replace(
        seeds, quat=quat_from_normals(axis), scale_m=thin(seeds.scale_m, thickness)
    )


def pushed_back(ctx: SeedContext, seeds: Seeds, factor: float) -> Seeds:
    """The same seeds as if the depth had been ``factor`` times as large: farther from the camera,
    and larger."""
    eye = ctx.frame.T_WC[:3, 3]
    return dataclasses.replace(
        seeds, xyz_W=eye + factor * (seeds.xyz_W - eye), scale_m=factor * seeds.scale_m
    )


def thin(scale_m: Float[Tensor, "N 3"], thickness: float) -> Float[Tensor, "N 3"]:
    """Standard deviations of which the third is multiplied by ``thickness``."""
    return scale_m * scale_m.new_tensor([1.0, 1.0, thickness])


def quat_from_normals(normal: Float[Tensor, "M 3"]) -> Float[Tensor, "M 4"]:
    """Unit quaternions, wxyz, that turn the z axis to the normals by the smaller angle; a disc is
    then thin along z. A normal need not have unit length; a zero one gives the identity. [M, 4]"""
    length = normal.norm(dim=1, keepdim=True)
    z = torch.zeros_like(normal)
    z[:, 2] = 1.0
    return quaternion.shortest_arc(z, torch.where(length > 0, normal / length, z))
