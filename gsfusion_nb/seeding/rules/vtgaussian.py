"""VTGaussian-SLAM's rule: SplaTAM's test, with finer Gaussians where the colour varies; they stay where they are."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch

from ...types import Seeds
from ..context import SeedContext
from ..rule import EVERY_FRAME, MapRule, When, seeding_rule
from ..sampling import one_pixel_seeds, pixel_radius, pushed_back, unmapped_pixels

PUSH_BACK = 1.005
"""Depth is multiplied by this before points are placed and sized."""
QUARTERS = torch.tensor([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]])


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class vtgaussian(MapRule):
    """VTGaussian-SLAM: SplaTAM's pixels, four finer ones besides where the colour varies; Gaussians that do not move.

    A round Gaussian of one pixel for each pixel with depth where A < 0.5, or D^ > D and |D^ - D| > 50 medians. Near
    edges of the picture (Canny 50/200 of the Euclidean gradient, dilated 3 x 3) there are four more of half a pixel, at
    the centres of its quarters. Depth is multiplied by 1.005. Centres and rotations are not optimised ("view-tied").

    Args:
        min_alpha: Pixels with a smaller accumulated opacity A are seeded. Release: 0.5.
        median_factor: How many medians a depth error must exceed. Release: 50.
        fine: Whether there are finer Gaussians near edges. Release: True.
        share: Share of the Gaussians that is drawn at random, 0..1, with sizes 1 / sqrt(share) times as large. Release:
            1.
        median_of: The median over "all" pixels counts missing depth as an error of 0, as in the release.

    The release reads depth and colour of the quarters from images of twice the size; here they are those of the pixel.
    Left out: sections of 40 frames, each with its own Gaussians, and tracking against them.
    Source: Hu and Han 2025 (VTGaussian-SLAM) and its released code.
    """

    min_alpha: float = 0.5
    median_factor: float = 50.0
    fine: bool = True
    share: float = 1.0
    median_of: Literal["all", "measured"] = "all"

    when: ClassVar[When] = EVERY_FRAME
    overrides: ClassVar[Mapping[str, Any]] = {"optim__lr_xyz": 0.0, "optim__lr_quat": 0.0}

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """Coarse and fine Gaussians of one frame."""
        chosen = unmapped_pixels(ctx, self.min_alpha, self.median_factor, median_of=self.median_of)
        coarse = one_pixel_seeds(ctx, chosen, share=self.share)
        if not self.fine:
            return pushed_back(ctx, coarse, PUSH_BACK)
        uv = ctx.pixels(chosen & ctx.edges(50.0, 200.0, 3, euclidean=True))
        uv = (uv[:, None] + QUARTERS.to(uv)).reshape(-1, 2)
        uv = uv[ctx.draw(len(uv), round(self.share * len(uv)))]
        fine = ctx.seeds_at(uv, 0.5 * pixel_radius(ctx, self.share))
        return pushed_back(ctx, Seeds.cat([coarse, fine]), PUSH_BACK)
