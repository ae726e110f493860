"""Photo-SLAM's rule for RGB-D: every corner with depth in each keyframe."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from ...types import Seeds
from ..context import SeedContext
from ..rule import KEYFRAMES, MapRule, When, seeding_rule
from ..sampling import sized_by_neighbours


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class photo_slam(MapRule):
    """Photo-SLAM: in keyframes, a Gaussian for each ORB corner with depth, whatever is mapped.

    Round Gaussians as large as the root mean square distance to their 3 nearest neighbours among the new ones; opacity
    0.1.

    Args:
        corners: Number of corners per keyframe, at most. The release takes all those of its tracker; 1000 is usual.
        max_depth_m: Corners farther away are left out, metres; 0: no limit. Nearer than ``ctx.near_m`` are left out,
            too.

    Left out: the map points of ORB-SLAM3, which the release seeds as well; the delay of 10 keyframes until new points
    are added; 3DGS's densification and the training on an image pyramid, which belong to the optimiser. The corners
    here are not spread over the image as ORB-SLAM3 spreads them. Every 5th recorded frame is a keyframe unless the
    settings say otherwise.
    Source: Huang et al. 2024 (Photo-SLAM) and its released code ("inactive geometry densification").
    """

    corners: int = 1000
    max_depth_m: float = 0.0

    when: ClassVar[When] = KEYFRAMES
    overrides: ClassVar[Mapping[str, Any]] = {"keyframe_every": 5}

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The corners of one keyframe."""
        uv = ctx.corners(self.corners)
        if self.max_depth_m > 0:
            uv = uv[ctx.values_at(ctx.frame.depth_m, uv) <= self.max_depth_m]
        return sized_by_neighbours(ctx, ctx.seeds_at(uv, 1.0, opacity=0.1))
