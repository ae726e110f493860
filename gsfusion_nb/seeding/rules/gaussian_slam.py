"""Gaussian-SLAM's rule: a dense start of each submap, then every fifth frame what the map does not cover."""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from jaxtyping import Bool
from torch import Tensor

from ...types import Seeds
from ..context import SeedContext
from ..rule import MapRule, When, every, seeding_rule
from ..sampling import pushed_back, sized_by_neighbours, unmapped_pixels

GRADIENT_POINTS = 50_000
PUSH_BACK = 1.005
"""Depth is multiplied by this: seeds lie slightly behind the surface."""


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Values of the release for one data set."""

    submap_points: int
    """Points drawn from all pixels where a submap starts."""
    frame_points: int
    """Most points of another frame; 0: no limit."""
    min_square_m2: float
    """A point closer than the root of this to a Gaussian of the map is rejected. The release calls it a radius and
    compares it with squared distances."""
    removes_outliers: bool


PRESETS = {
    "replica": Preset(submap_points=600_000, frame_points=0, min_square_m2=1e-7, removes_outliers=False),
    "tum": Preset(submap_points=100_000, frame_points=30_000, min_square_m2=1e-4, removes_outliers=True),
    "scannetpp": Preset(submap_points=400_000, frame_points=100_000, min_square_m2=1e-8, removes_outliers=False),
}


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class gaussian_slam(MapRule):
    """Gaussian-SLAM: a dense start of each submap, then every fifth frame what the map does not cover.

    Where a submap starts, every 50 mapped frames: the union of random pixels, of 50,000 pixels drawn in proportion to
    the image gradient, and of all edges (Canny 100/200 of the Euclidean gradient, dilated 2 x 2). In every fifth frame
    between: the pixels where

        A < 0.6   or   ( D^ > D  and  |D^ - D| > 40 median |D^ - D| )

    Depth is multiplied by 1.005; points close to a Gaussian of the map are rejected. Round Gaussians as large as the
    root mean square distance to their 3 nearest neighbours, new or in the map.

    Args:
        preset: Number of points, distance from existing Gaussians, outlier filter, as in the release: "replica"
            (600,000 points, 0.3 mm), "tum" (100,000, 1 cm, filter with 40 neighbours and 2 standard deviations except
            in the first frame), "scannetpp" (400,000, 0.1 mm). Smaller images have fewer pixels; then all are taken.
        min_alpha: Pixels with a smaller accumulated opacity A are seeded. Release: 0.6.
        median_factor: How many medians a depth error must exceed. Release: 40.
        share: Share of these pixels that is drawn at random, 0..1; the sizes follow from the distances. Release: 1.
        restart: Whether a new submap is started densely, as in the release, whose submaps begin empty. False: only the
            first frame is; in one map, which is all there is here, a restart adds Gaussians where there are some.

    The release maps every fifth frame on Replica, every frame on TUM, every second one on ScanNet++ (submaps of 100).
    D^ is the blended depth, not divided by A, as in the release: the gradient of the depth in its rasteriser
    (gaussian_rasterizer, ``backward.cu``) is that of the plain sum over alpha T z.
    Left out because the optimiser does it: fixed colours, pruning at opacity 0.1 or 0.5, the isotropy loss, separate
    optimisation of submaps. Neighbours outside the view count as well when points are rejected.
    Source: Yugay et al. 2023 (Gaussian-SLAM) and its released code, also LoopSplat's.
    """

    preset: Literal["replica", "tum", "scannetpp"] = "replica"
    min_alpha: float = 0.6
    median_factor: float = 40.0
    share: float = 1.0
    restart: bool = True

    when: ClassVar[When] = every(5, submap_frames=50)

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The points of one mapped frame."""
        preset = PRESETS[self.preset]
        if not ctx.has_map or (self.restart and ctx.starts_submap):
            chosen, limit = _start_of_submap(ctx, preset.submap_points), 0
        else:
            chosen, limit = unmapped_pixels(ctx, self.min_alpha, self.median_factor), preset.frame_points
        uv = ctx.pixels(chosen)
        count = round(self.share * min(len(uv), limit or len(uv)))
        seeds = pushed_back(ctx, ctx.seeds_at(uv[ctx.draw(len(uv), count)], 1.0), PUSH_BACK)
        if ctx.has_map:
            distance = ctx.nearest(seeds.xyz_W, 1, "map").distance_m[:, 0]
            seeds = seeds[distance.square() >= preset.min_square_m2]
            if preset.removes_outliers:
                seeds = seeds[~ctx.outliers(seeds.xyz_W, 40, 2.0)]
        return sized_by_neighbours(ctx, seeds, "new and map")


def _start_of_submap(ctx: SeedContext, points: int) -> Bool[Tensor, "H W"]:
    """Random pixels, pixels on strong gradients, and edges."""
    known = ctx.has_depth().flatten()
    chosen = ctx.edges(100.0, 200.0, 2, euclidean=True).flatten() & known
    candidate = known.nonzero()[:, 0]
    chosen[candidate[ctx.draw(len(candidate), points)]] = True
    chosen[ctx.draw_weighted(ctx.gradient().flatten() * known, GRADIENT_POINTS)] = True
    return chosen.view(ctx.camera.height, ctx.camera.width)
