"""Gaussians where depth is missing, at the depth of the pixels around."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..render.constants import SHOWN_ALPHA
from ..types import Seeds
from .context import SeedContext
from .quadtree import cell_gaussians

LEAST_HALF_PX = 2
"""Cells are not cut to less than this half width: at a guessed depth the finest detail is not worth
its Gaussians. On the kitchen it saves half of the added Gaussians and costs 0.2 dB of 1.5."""


def cells_without_depth(ctx: SeedContext) -> Seeds:
    """One round seed per quadtree leaf whose middle has no depth and is not shown by the map.

    The cells are not cut to the smallest. The depth is that of the measured pixels around
    (``depth_from_sides``); everything else is as in ``SeedContext.cells``. Depth nearer than
    ``ctx.near_m`` is measured, not missing: such leaves get no Gaussian. In a frame without any
    depth there are none.

    Differentiable: no. Source: ours; docs/quality.md has what it changes.
    """
    depth_m = ctx.frame.depth_m
    has_depth = ctx.has_depth()
    if not (depth_m <= 0).any() or not has_depth.any():
        return Seeds.empty(depth_m)
    leaves = ctx.quadtree_cells(min_cell_px=max(LEAST_HALF_PX, ctx.config.quadtree_min_cell_px))
    i, j = leaves.centre_uv.floor().long().unbind(-1)
    mask = depth_m[j, i] <= 0
    if ctx.has_map and mask.any():
        mask &= ctx.render().alpha[j, i] < SHOWN_ALPHA
    if not mask.any():
        return Seeds.empty(depth_m)
    leaves = leaves[mask]
    i = i[mask]
    j = j[mask]
    filled_m = depth_from_sides(depth_m, has_depth)
    has_estimate = filled_m[j, i] > 0
    leaves = leaves[has_estimate]
    i = i[has_estimate]
    j = j[has_estimate]
    xyz_W, scale_m = cell_gaussians(ctx.camera, leaves, filled_m, ctx.frame.T_WC)
    return Seeds.isotropic(
        xyz_W,
        ctx.frame.rgb[j, i],
        scale_m,
        opacity=0.5,
        tag=leaves.level,
    )


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
