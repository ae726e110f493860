"""CG-SLAM's rule: what the map does not cover, every thirty frames."""

from dataclasses import dataclass
from typing import Any, ClassVar

from ...types import Seeds
from ..context import SeedContext
from ..rule import MapRule, When, every, seeding_rule
from ..sampling import sized_by_neighbours


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class cg_slam(MapRule):
    """CG-SLAM: every 30 frames, a Gaussian for each pixel that the map does not cover.

    Each pixel with depth where A < 0.5. Round Gaussians as large as the root mean square distance to their 3 nearest
    neighbours, new or in the map.

    Args:
        min_alpha: Pixels with a smaller accumulated opacity A are seeded. Release: 0.5.
        share: Share of the pixels that is drawn at random, 0..1; the sizes follow from the distances. Release: 1.

    In the release only visible Gaussians of the map count as neighbours; here all do, of which the nearest 3 are almost
    always visible. Left out because the optimiser does it: one step of splitting and pruning halfway (opacity 0.005, 20
    pixels), the anisotropy loss, and uncertainty. The release maps every 30th frame on Replica.
    Source: Hu et al. 2024 (CG-SLAM) and its released code.
    """

    min_alpha: float = 0.5
    share: float = 1.0

    when: ClassVar[When] = every(30)

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The points of one mapped frame."""
        uv = ctx.pixels(ctx.render().alpha < self.min_alpha if ctx.has_map else None)
        uv = uv[ctx.draw(len(uv), round(self.share * len(uv)))]
        return sized_by_neighbours(ctx, ctx.seeds_at(uv, 1.0), "new and map")
