"""ConeGS's rule: pixels drawn by their colour error, each a Gaussian as wide as the pixel's cone."""

from dataclasses import dataclass
from typing import Any

from ...gaussians import Edit
from ...types import Seeds
from ..context import SeedContext
from ..rule import MapRule, StepStats, seeding_rule
from ..sampling import sized_by_neighbours

OPACITY, MIN_OPACITY, PRUNE_EVERY = 0.1, 0.005, 100


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class cone_gs(MapRule):
    """ConeGS: pixels drawn with a probability in proportion to their colour error, as wide as the cone of a pixel.

    A pixel seen at depth z is z / fx wide and z / fy high. A new Gaussian lies on the ray of its pixel, at the measured
    depth, is round, and its standard deviation is the mean of the two, the diameter of the pixel's cone. Pixels are
    drawn without replacement with weights mean |C^ - C| over R, G, B, whatever the map's geometry is. Opacity 0.1.
    Every 100 gradient steps, Gaussians with an opacity up to 0.005 are removed.

    The first frame gives the initial Gaussians: pixels drawn at random, as large as the root mean square distance to
    their 3 nearest neighbours.

    Args:
        share: Share of the pixels of the first frame. In later frames the number of Gaussians is this share of the sum
            of the errors (0..1 each), so a wrong frame gets many and a right one few. Chosen here: the release adds 2 %
            of the Gaussians in 100 steps on all frames, while here each frame comes once.
        max_points: No more Gaussians than this; 0: no limit. The release's budget.

    Depth is measured here; the release trains an Instant-NGP model for it, whose colours it takes, too. Left out: its
    penalty of 0.0002 times the mean opacity logit, and its learning rates.
    Source: Baranowski et al. 2025 (ConeGS, arXiv 2511.06810) and its released code.
    """

    share: float = 0.05
    max_points: int = 0

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The Gaussians of one frame."""
        if not ctx.has_map:
            uv = ctx.pixels()
            uv = uv[ctx.draw(len(uv), self._room(ctx, round(self.share * len(uv))))]
            return sized_by_neighbours(ctx, ctx.seeds_at(uv, 1.0, opacity=OPACITY))
        error = (ctx.render().rgb - ctx.frame.rgb).abs().mean(dim=-1)[ctx.has_depth()]
        uv = ctx.pixels()[ctx.draw_weighted(error, self._room(ctx, round(self.share * float(error.sum()))))]
        return ctx.seeds_at(uv, (1 + ctx.camera.fx / ctx.camera.fy) / 2, opacity=OPACITY)  # seeds_at divides by fx

    def after_step(self, ctx: SeedContext, stats: StepStats, memory: dict[str, Any]) -> Edit | None:
        """Remove transparent Gaussians, where it is time."""
        if stats.step % PRUNE_EVERY:
            return None
        keep = ctx.map.opacity > MIN_OPACITY
        return None if keep.all() else Edit(keep=keep)

    def _room(self, ctx: SeedContext, count: int) -> int:
        room = self.max_points - (len(ctx.map) if ctx.has_map else 0)
        return min(count, max(room, 0)) if self.max_points else count
