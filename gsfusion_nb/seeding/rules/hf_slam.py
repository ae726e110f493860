"""HF-SLAM's rule: pixels that the map does not cover, or whose colour or relative depth is wrong."""

import torch
from jaxtyping import Float
from torch import Tensor

from ...render import render_forward
from ...types import Seeds
from ..context import SeedContext
from ..rule import seeding_rule
from ..sampling import depth_error_m, one_pixel_seeds


@seeding_rule
def hf_slam(
    ctx: SeedContext,
    *,
    min_alpha: float = 0.5,
    colour_error: float = 0.6,
    relative_depth_error: float = 0.1,
    share: float = 1.0,
    as_released: bool = True,
) -> Seeds:
    """HF-SLAM: a Gaussian of one pixel wherever the map does not cover the view, or its colour or depth is wrong.

    Round, with standard deviation z / f, f = (fx + fy) / 2, for each pixel with depth where

        A < 0.5   or   mean over R, G, B of |C^ - C| > 0.6   or   |D^ - D| / D > 0.1

    with the map's accumulated opacity A, picture C^ and blended depth D^ (not divided by A, as in SplaTAM, from which
    HF-SLAM is derived). Unlike SplaTAM's, the depth test is relative to the distance and has no median.

    The release sums the opacity with the transmittance behind each Gaussian, A = sum alpha_k T_{k+1}, T_{k+1} = T_k
    (1 - alpha_k), in place of alpha_k T_k. So one Gaussian adds at most 0.25, and opaque ones next to nothing: pixels
    that are covered by opaque Gaussians are seeded again in every frame.

    Args:
        ctx: Frame and Gaussian map.
        min_alpha: Pixels with a smaller A are seeded. Release: 0.5.
        colour_error: Mean absolute colour error (0..1) above which a pixel is seeded. Release: 0.6.
        relative_depth_error: Depth error as a share of the depth above which a pixel is seeded. Release: 0.1.
        share: Share of the pixels that is drawn at random, 0..1, with sizes 1 / sqrt(share) times as large. Release: 1.
        as_released: A as the release sums it; False: as everywhere else, sum alpha_k T_k.

    The release neither prunes nor densifies; so nothing of its optimiser is left out.
    Source: the released code of HF-SLAM.
    """
    chosen = ctx.has_depth()
    if ctx.has_map:
        view = ctx.render()
        colour = (view.rgb - ctx.frame.rgb).abs().mean(dim=-1) > colour_error
        depth = depth_error_m(ctx) > relative_depth_error * ctx.frame.depth_m
        alpha = alpha_behind(ctx) if as_released and ctx.below is None else view.alpha
        chosen = chosen & ((alpha < min_alpha) | colour | depth)
    return one_pixel_seeds(ctx, chosen, share=share)


def alpha_behind(ctx: SeedContext) -> Float[Tensor, "H W"]:
    """sum_k alpha_k T_{k+1}, with the light that is left behind each Gaussian in place of in front of it. [H, W]"""
    screen = render_forward(ctx.gaussians.params, ctx.camera, ctx.frame.T_WC, with_indices=False)[1].screen
    A = torch.zeros_like(ctx.frame.depth_m)
    for tile in range(screen.tiles.tiles_x * screen.tiles.tiles_y):
        x, y = screen.pixels_of(tile, ctx.camera)
        blended = screen.blend(tile, x, y)
        A[y, x] = (blended.weight * (1 - blended.alpha)).sum(dim=0)
    return A
