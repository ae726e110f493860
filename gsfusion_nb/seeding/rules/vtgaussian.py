"""VTGaussian-SLAM's rule: SplaTAM's test, with finer Gaussians where the colour varies; they stay where they are."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from ...types import Seeds
from ..context import SeedContext
from ..footprint import one_pixel_seeds, pixel_radius
from ..map_rule import EVERY_FRAME, MapRule, When
from ..rule import seeding_rule
from ..unmapped import unmapped_pixels

QUARTERS = torch.tensor([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]])


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class vtgaussian(MapRule):
    """VTGaussian-SLAM: SplaTAM's pixels, finer where the colour varies, and Gaussians that do not move.

    A round Gaussian of one pixel for each pixel with depth where A < 0.5, or D^ > D and |D^ - D| > 50 medians; in its
    place four of half a pixel where the colour varies. Centres and rotations are not optimised ("view-tied").

    Args:
        min_alpha: Pixels with a smaller accumulated opacity A are seeded. Release: 0.5.
        median_factor: How many medians a depth error must exceed. Release: 50.
        detail: Length of the brightness gradient per pixel (0..1) above which a pixel gets four Gaussians. The release
            adds samples of the twice enlarged image where the colour varies; its threshold was not available, 0.1 is
            chosen here. A negative number splits every pixel.
        share: Share of the pixels that is drawn at random, 0..1, with sizes 1 / sqrt(share) times as large. Release: 1.
        median_of: The median over "all" pixels counts missing depth as an error of 0, as in the release.

    Left out: sections of 40 frames, each with its own Gaussians, and tracking against them.
    Source: Hu and Han 2025 (VTGaussian-SLAM) and its released code.
    """

    min_alpha: float = 0.5
    median_factor: float = 50.0
    detail: float = 0.1
    share: float = 1.0
    median_of: Literal["all", "measured"] = "all"

    when: ClassVar[When] = EVERY_FRAME
    overrides: ClassVar[Mapping[str, Any]] = {"optim__lr_xyz": 0.0, "optim__lr_quat": 0.0}

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """Coarse and fine Gaussians of one frame."""
        chosen = unmapped_pixels(ctx, self.min_alpha, self.median_factor, median_of=self.median_of)
        fine = chosen & (ctx.gradient() > self.detail)
        return Seeds.cat([one_pixel_seeds(ctx, chosen & ~fine, share=self.share), self._in_four(ctx, fine)])

    def _in_four(self, ctx: SeedContext, fine: Bool[Tensor, "H W"]) -> Seeds:
        """Four Gaussians for each pixel, at the centres of its quarters."""
        uv = ctx.pixels(fine)
        uv = (uv[:, None] + QUARTERS.to(uv)).reshape(-1, 2)
        uv = uv[ctx.draw(len(uv), round(self.share * len(uv)))]
        return ctx.seeds_at(uv, 0.5 * pixel_radius(ctx, self.share))
