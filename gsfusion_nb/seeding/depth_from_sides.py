"""A guess of missing depth, from the measured depth around it."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def depth_from_sides(
    depth_m: Float[Tensor, "H W"], has_depth: Bool[Tensor, "H W"]
) -> Float[Tensor, "H W"]:
    """At each pixel the mean of the nearest known depths to the left, right, above and below,
    weighted by 1/distance^2.

    0 where there is none in its row and column.

    Args:
        depth_m: z-depth, metres. [H, W]
        has_depth: Pixels whose depth is used. [H, W]
    """
    total = torch.zeros_like(depth_m)
    weights = torch.zeros_like(depth_m)
    for dim in (0, 1):
        for backwards in (False, True):
            d, k = (depth_m.flip(dim), has_depth.flip(dim)) if backwards else (depth_m, has_depth)
            place = torch.arange(d.shape[dim], device=d.device)
            place = (place[:, None] if dim == 0 else place[None]).expand(d.shape)
            last = torch.where(k, place, -1).cummax(dim).values
            nearest_m = d.gather(dim, last.clamp_min(0))
            weight = torch.where(
                last >= 0,
                1.0 / (place - last).clamp_min(1).to(d).square(),
                0.0,
            )
            nearest_m, weight = (
                (nearest_m.flip(dim), weight.flip(dim)) if backwards else (nearest_m, weight)
            )
            total = total + weight * nearest_m
            weights = weights + weight
    return torch.where(weights > 0, total / weights.clamp_min(1e-30), 0.0)
