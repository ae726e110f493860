"""Gaussians where depth is missing, at the depth of the pixels around."""

from ..render.constants import SHOWN_ALPHA
from ..types import Seeds
from .context import SeedContext
from .frame_queries import filled_depth
from .quadtree import cell_gaussians

LEAST_HALF_PX = 2
"""Cells are not cut to less than this half width: at a guessed depth the finest detail is not worth
its Gaussians. On the kitchen it saves half of the added Gaussians and costs 0.2 dB of 1.5."""


def cells_without_depth(ctx: SeedContext) -> Seeds:
    """One round seed per quadtree leaf whose middle has no depth and is not shown by the map.

    The cells are not cut to the smallest. The depth is that of the measured pixels around
    (``depth_from_sides``). The seeds are round and half opaque, because their depth is a guess;
    everything else is as in ``SeedContext.cells``. Depth nearer than ``ctx.near_m`` is measured,
    not missing: such leaves get no Gaussian. In a frame without any depth there are none.

    Differentiable: no. Source: ours; docs/quality.md has what it changes.
    """
    depth_m = ctx.frame.depth_m
    if not (depth_m <= 0).any() or not ctx.has_depth().any():
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
    filled_m = filled_depth(ctx)
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
