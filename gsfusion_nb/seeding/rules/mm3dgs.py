"""MM3DGS's rule: SplaTAM's with depth errors of both signs."""

from typing import Literal

from ...types import Seeds
from ..context import SeedContext
from ..rule import seeding_rule
from ..sampling import one_pixel_seeds, unmapped_pixels


@seeding_rule
def mm3dgs(
    ctx: SeedContext,
    *,
    method: Literal["own", "splatam"] = "own",
    min_alpha: float = 0.5,
    share: float = 1.0,
    median_of: Literal["all", "measured"] = "all",
) -> Seeds:
    """MM3DGS: a Gaussian of one pixel wherever the map does not cover the view, or its depth is wrong by far.

    Round, with standard deviation z / f, f = (fx + fy) / 2, for each pixel with depth where A < 0.5 or |D^ - D| > 10
    median |D^ - D|, whether the measured surface lies in front of the map's or behind it.

    Args:
        ctx: Frame and Gaussian map.
        method: "own": as above; "splatam": the other method of the release: 50 medians, and only in front.
        min_alpha: Pixels with a smaller accumulated opacity are seeded. Release: 0.5.
        share: Share of the pixels that is drawn at random, 0..1, with sizes 1 / sqrt(share) times as large. Release: 1.
        median_of: The median over "all" pixels counts missing depth as an error of 0, as in the release.

    Left out because the optimiser does it: 3DGS's densification and pruning every 50 steps. D^ is the blended depth
    that is not divided by A, as in the release.
    Source: the released code of MM3DGS.
    """
    own = method == "own"
    chosen = unmapped_pixels(
        ctx, min_alpha, 10.0 if own else 50.0, sides="both" if own else "in front", median_of=median_of
    )
    return one_pixel_seeds(ctx, chosen, share=share)
