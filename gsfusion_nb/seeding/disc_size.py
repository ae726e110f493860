"""Radius of a new disc: it covers the gap to its neighbours, with little overlap (Peng et al. 2024, section 3.2)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .nearest import k_nearest, nearest_others

NEIGHBOURS = 3
"""Number of nearest neighbours that are considered (released code)."""
REACH = 3.0
"""An existing disc covers the space within this many of its radii (released code)."""
BORDER_M = 0.05
"""Existing discs farther than this outside the new points' bounding box are ignored, metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Gaps:
    """Free space around new points."""

    gap_m: Float[Tensor, "M K"]
    """Distance to each of the nearest neighbours minus the radius that it covers; negative inside it, metres."""

    @property
    def overlaps(self) -> Bool[Tensor, " M"]:
        """Whether the point lies within a neighbour's reach."""
        return (self.gap_m < 0).any(dim=1)

    @property
    def size_m(self) -> Float[Tensor, " M"]:
        """Root mean square of the gaps, where a negative gap counts as 0, metres."""
        return self.gap_m.clamp_min(0.0).square().mean(dim=1).sqrt()


def gaps_around(
    xyz_W: Float[Tensor, "M 3"],
    neighbour_xyz_W: Float[Tensor, "N 3"],
    neighbour_radius_m: Float[Tensor, " N"],
    *,
    reach: float = REACH,
    neighbours: int = NEIGHBOURS,
) -> Gaps:
    """d_i = |x - x_i| - reach r_i for the nearest centres x_i, other new points (r = 0) and existing discs alike.

    Args:
        xyz_W: New points, metres.
        neighbour_xyz_W: Centres of the discs that exist.
        neighbour_radius_m: Their radii.
        reach: An existing disc covers the space within this many of its radii.
        neighbours: Number of nearest neighbours; fewer if there are fewer points.

    Differentiable: no. Source: the released code (the paper says "cover the scene ... with little overlapping").
    """
    M = len(xyz_W)
    if M == 0:
        return Gaps(gap_m=xyz_W.new_zeros(0, neighbours))
    low, high = xyz_W.amin(0) - BORDER_M, xyz_W.amax(0) + BORDER_M
    near = ((neighbour_xyz_W >= low) & (neighbour_xyz_W <= high)).all(dim=1)
    k = min(neighbours, M + int(near.sum()) - 1)
    if k == 0:
        return Gaps(gap_m=xyz_W.new_full((1, 1), torch.inf))
    found = nearest_others(xyz_W, neighbour_xyz_W[near], k)
    radius = torch.cat([xyz_W.new_zeros(M), neighbour_radius_m[near]])
    return Gaps(gap_m=found.distance_m - reach * radius[found.row])


def nearest(
    xyz_W: Float[Tensor, "M 3"], others_W: Float[Tensor, "N 3"], neighbours: int = NEIGHBOURS
) -> tuple[Float[Tensor, "M K"], Tensor]:
    """Distance to the nearest of ``others_W``, metres, and their rows; infinite, and row 0, if there are fewer."""
    distance, row = k_nearest(xyz_W, others_W, neighbours)
    return distance, row.masked_fill(row == len(others_W), 0)
