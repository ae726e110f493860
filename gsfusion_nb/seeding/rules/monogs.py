"""MonoGS's rule: a small random share of every keyframe, whatever is mapped."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from ...types import Seeds
from ..context import SeedContext
from ..rule import KEYFRAMES, MapRule, When, seeding_rule
from ..sampling import sized_by_neighbours

PRESETS = {"replica": (1 / 64, 0.05), "tum": (1 / 128, 0.01)}
"""Share of a keyframe's pixels; point size."""
FIRST_SHARE, MAX_POINT_SIZE, MIN_COLOUR_SUM = 1 / 32, 0.05, 0.01


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class monogs(MapRule):
    """MonoGS: in keyframes, a small random share of all pixels, whatever is mapped.

    1/64 of the pixels with depth, in the first frame 1/32. Round Gaussians of standard deviation sqrt(d^2 p): d^2 is
    the mean squared distance to the 3 nearest of the new points, p = min(0.05, c median(D)) the point size. Black
    pixels (R + G + B <= 0.01) are left out.

    Args:
        preset: "replica": 1/64, c = 0.05; "tum": 1/128, c = 0.01, as in the release for these data sets.
        density: Multiplies the number of points; the sizes follow from their distances. Release: 1.

    The median of the depth is taken over the pixels that have depth. Left out because the optimiser does it: 3DGS's
    densification, opacity resets, covisibility pruning and the isotropy loss (``monogs_like`` has some of it). MonoGS
    chooses keyframes by overlap and motion, at least every 4th frame (Replica) or 5th (TUM); here every 5th mapped
    frame is one unless the settings say otherwise. Its mode without depth is left out.
    Source: Matsuki et al. 2024 (MonoGS) and its released code.
    """

    preset: Literal["replica", "tum"] = "replica"
    density: float = 1.0

    when: ClassVar[When] = KEYFRAMES
    overrides: ClassVar[Mapping[str, Any]] = {"keyframe_every": 5}

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The points of one keyframe."""
        share, c = PRESETS[self.preset]
        share = self.density * (share if ctx.has_map else FIRST_SHARE)
        uv = ctx.pixels()
        uv = uv[ctx.draw(len(uv), int(share * len(uv)))]
        seeds = ctx.seeds_at(uv, 1.0)
        seeds = seeds[seeds.rgb.sum(dim=1) > MIN_COLOUR_SUM]
        if len(seeds) == 0:
            return seeds
        point_size = min(MAX_POINT_SIZE, c * float(ctx.frame.depth_m[ctx.has_depth()].median()))
        return sized_by_neighbours(ctx, seeds, factor=point_size**0.5)
