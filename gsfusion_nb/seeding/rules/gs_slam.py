"""GS-SLAM's rule, as far as the paper describes it: pixels that are not covered, or wrong in depth."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from ...types import Seeds
from ..context import SeedContext
from ..rule import KEYFRAMES, MapRule, When, seeding_rule
from ..sampling import depth_error_m, sized_by_neighbours


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class gs_slam(MapRule):
    """GS-SLAM: in keyframes, Gaussians wherever the map does not cover the view, or its depth is wrong.

    In the first frame half of the pixels with depth, drawn at random; in later keyframes those where A < tau_T or
    |D^ - D| > tau_D. Round Gaussians, as large as the root mean square distance to their 3 nearest neighbours, new or
    in the map.

    Args:
        first_share: Share of the pixels of the first frame. Publication: half.
        min_alpha: tau_T: pixels with a smaller accumulated opacity A are seeded; 0.5 is chosen here.
        depth_error: tau_D, metres: larger errors of the blended depth are seeded; 0.1 is chosen here.
        share: Share of all these pixels that is drawn at random, 0..1; the sizes follow from the distances.
            Publication: 1.
        opacity: The publication presets one value; 0.5 is chosen here.

    The three values chosen here cannot be compared with the authors': the paper leaves its numbers to a supplement, and
    no code was released.

    Left out because the optimiser does it: a Gaussian in front of the measured depth by more than gamma gets eta times
    its opacity; splitting and cloning. Every 5th recorded frame is a keyframe unless the settings say otherwise.
    Source: Yan et al. 2024 (GS-SLAM), the paper alone.
    """

    first_share: float = 0.5
    min_alpha: float = 0.5
    depth_error: float = 0.1
    share: float = 1.0
    opacity: float = 0.5

    when: ClassVar[When] = KEYFRAMES
    overrides: ClassVar[Mapping[str, Any]] = {"keyframe_every": 5}

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The points of one keyframe."""
        chosen, share = None, self.share * self.first_share
        if ctx.has_map:
            chosen = (ctx.render().alpha < self.min_alpha) | (depth_error_m(ctx) > self.depth_error)
            share = self.share
        uv = ctx.pixels(chosen)
        seeds = ctx.seeds_at(uv[ctx.draw(len(uv), round(share * len(uv)))], 1.0, opacity=self.opacity)
        return sized_by_neighbours(ctx, seeds, "new and map")
