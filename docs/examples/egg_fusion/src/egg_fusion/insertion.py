"""EGG-Fusion's rule for new surfels: where the map covers nothing, or lies behind what is measured
(section 3.2.1)."""

import torch

from gsfusion_nb.seeding import SeedContext, Seeds, as_discs, draw_rows, seeding_rule

BORDER = 7 / 640
"""Width of the border without new surfels, as a share of the picture's."""
THICKNESS = 0.01
"""Of a surfel, as a share of its size: the renderer has no flat Gaussians."""
OPACITY = 0.99


@seeding_rule
def egg_insertion(
    ctx: SeedContext,
    *,
    min_alpha: float = 0.8,
    behind_m: float = 0.05,
    share: float = 0.025,
    first_share: float = 0.2,
    size_px: float = 2.0,
) -> Seeds:
    """A random share of the pixels that the map does not cover, or that are in front of it.

    Args:
        ctx: Frame and map.
        min_alpha: Pixels with a smaller accumulated opacity are seeded. Published: 0.8.
        behind_m: Pixels are seeded, too, where the map is so far behind them, metres.
        share: Share of these pixels that is drawn. Published: 0.025.
        first_share: The same of all pixels of the first frame. Published: 0.2.
        size_px: Standard deviation of a new surfel in pixels. Published: 2.
    """
    normal_W = ctx.normals_W()
    mask = (normal_W != 0).any(dim=-1)
    inside = torch.zeros_like(mask)
    border = max(1, round(BORDER * ctx.camera.width))
    inside[border:-border, border:-border] = True
    if ctx.has_map:
        seen = ctx.render()
        depth_m = seen.depth_m / seen.alpha.clamp_min(1e-6)
        mask &= (seen.alpha < min_alpha) | (depth_m - ctx.frame.depth_m > behind_m)
    uv = ctx.pixels(mask & inside)
    n = round((share if ctx.has_map else first_share) * len(uv))
    uv = uv[draw_rows(ctx, len(uv), n)]
    seeds = ctx.seeds_at(uv, size_px, opacity=OPACITY)
    return as_discs(ctx, seeds, ctx.values_at(normal_W, uv), THICKNESS)
