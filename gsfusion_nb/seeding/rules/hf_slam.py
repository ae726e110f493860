"""HF-SLAM's rule: pixels that the map does not cover, or whose colour or relative depth is wrong."""

from ...types import Seeds
from ..context import SeedContext
from ..footprint import one_pixel_seeds
from ..rule import seeding_rule
from ..unmapped import depth_error_m


@seeding_rule
def hf_slam(
    ctx: SeedContext,
    *,
    min_alpha: float = 0.5,
    colour_error: float = 0.6,
    relative_depth_error: float = 0.1,
    share: float = 1.0,
) -> Seeds:
    """HF-SLAM: a Gaussian of one pixel wherever the map does not cover the view, or its colour or depth is wrong.

    Round, with standard deviation z / f, f = (fx + fy) / 2, for each pixel with depth where

        A < 0.5   or   mean over R, G, B of |C^ - C| > 0.6   or   |D^ - D| / D > 0.1

    with the map's accumulated opacity A, picture C^ and blended depth D^ (not divided by A, as in SplaTAM, from which
    HF-SLAM is derived). Unlike SplaTAM's, the depth test is relative to the distance and has no median.

    Args:
        ctx: Frame and Gaussian map.
        min_alpha: Pixels with a smaller A are seeded. Release: 0.5.
        colour_error: Mean absolute colour error (0..1) above which a pixel is seeded. Release: 0.6.
        relative_depth_error: Depth error as a share of the depth above which a pixel is seeded. Release: 0.1.
        share: Share of the pixels that is drawn at random, 0..1, with sizes 1 / sqrt(share) times as large. Release: 1.

    The release neither prunes nor densifies; so nothing of its optimiser is left out.
    Source: the released code of HF-SLAM.
    """
    chosen = ctx.has_depth()
    if ctx.has_map:
        view = ctx.render()
        colour = (view.rgb - ctx.frame.rgb).abs().mean(dim=-1) > colour_error
        depth = depth_error_m(ctx) > relative_depth_error * ctx.frame.depth_m
        chosen = chosen & ((view.alpha < min_alpha) | colour | depth)
    return one_pixel_seeds(ctx, chosen, share=share)
