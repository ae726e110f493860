"""SplaTAM's rule: every pixel that the map does not cover, or in front of what it shows."""

from typing import Literal

from ...types import Seeds
from ..context import SeedContext
from ..rule import seeding_rule
from ..sampling import one_pixel_seeds, unmapped_pixels


@seeding_rule
def splatam(
    ctx: SeedContext,
    *,
    min_alpha: float = 0.5,
    median_factor: float = 50.0,
    share: float = 1.0,
    every_px: int = 1,
    median_of: Literal["all", "measured"] = "all",
) -> Seeds:
    """SplaTAM: a Gaussian of one pixel wherever the map does not cover the view, or lies behind the measured surface.

    Round, with standard deviation z / f, f = (fx + fy) / 2, for each pixel with depth where

        A < 0.5   or   ( D^ > D  and  |D^ - D| > 50 median |D^ - D| )

    with the map's accumulated opacity A and its blended depth D^, which is not divided by A. In the first frame every
    pixel with depth.

    Args:
        ctx: Frame and Gaussian map.
        min_alpha: Pixels with a smaller A are seeded. Publication and release: 0.5.
        median_factor: How many medians a depth error must exceed. Publication and release: 50.
        share: Share of the pixels that is drawn at random, 0..1, with sizes 1 / sqrt(share) times as large. Release: 1.
        every_px: Only every n-th pixel of every n-th row, n times as large. Release: 1; its variant SplaTAM-S: 2.
        median_of: The median over "all" pixels counts missing depth as an error of 0, as in the release.

    Left out because the optimiser does it: pruning (``splatam_like`` has it), and tracking. Colours are stored as here,
    without view dependence.
    Source: Keetha et al. 2024 (SplaTAM) and its released code.
    """
    chosen = unmapped_pixels(ctx, min_alpha, median_factor, median_of=median_of)
    return one_pixel_seeds(ctx, chosen, share=share, every_px=every_px)
