"""GauS-SLAM's rule: SplaTAM's test with flat Gaussians in the measured surface."""

from typing import Literal

from ...types import Seeds
from ..context import SeedContext
from ..rule import seeding_rule
from ..sampling import as_discs, drawn_pixels, pixel_radius, unmapped_pixels


@seeding_rule
def gaus_slam(
    ctx: SeedContext,
    *,
    min_alpha: float = 0.6,
    median_factor: float = 50.0,
    share: float = 1.0,
    thickness: float = 0.1,
    median_of: Literal["all", "measured"] = "all",
) -> Seeds:
    """GauS-SLAM: a disc of one pixel wherever the map does not cover the view, or lies behind the measured surface.

    Thin along the normal of the depth image, for each pixel with depth where

        A < 0.6   or   ( D^ > D  and  |D^ - D| > 50 median |D^ - D| )

    Args:
        ctx: Frame and Gaussian map.
        min_alpha: Pixels with a smaller accumulated opacity A are seeded. Release: 0.6.
        median_factor: How many medians a depth error must exceed. Release: 50.
        share: Share of the pixels that is drawn at random, 0..1, with sizes 1 / sqrt(share) times as large. Release: 1.
        thickness: Third standard deviation as a share of the other two. The release has flat Gaussians without one;
            0.1 is chosen here.
        median_of: The median over "all" pixels counts missing depth as an error of 0, as in the release.

    A disc without a normal (at edges and borders of the depth image) faces the camera. D^ is the blended depth divided
    by A, as in the release (``use_weight_norm``). Left out: its choice of keyframes (more than 1 % of the pixels have A
    < 0.5), pruning (opacity below 0.05, mean scale below 0.0005 or above 0.1), local maps, and growth into depth holes,
    which the release has switched off.
    Source: the released code of GauS-SLAM.
    """
    chosen = unmapped_pixels(ctx, min_alpha, median_factor, median_of=median_of, divided=True)
    uv = drawn_pixels(ctx, chosen, share)
    seeds = ctx.seeds_at(uv, pixel_radius(ctx, share))
    return as_discs(ctx, seeds, ctx.values_at(ctx.normals_W(), uv), thickness)
