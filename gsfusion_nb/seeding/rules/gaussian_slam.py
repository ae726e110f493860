"""Rules for what the map does not cover, with Gaussians as large as the distance to their
neighbours."""

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from ...gaussians import Edit
from ...geometry import quaternion
from ...types import Seeds
from ..context import SeedContext
from ..coverage import depth_error_m, in_front, unmapped_pixels
from ..discs import thin
from ..draws import draw_rows, draw_weighted_rows, drawn_pixels
from ..image_features import gradient_length, luma
from ..map_rule import KeyframeRule, MapRule, StepStats, When, every
from ..points import outliers
from ..rule import seeding_rule, trained_otherwise
from ..shapes import pushed_back, sized_by_neighbours

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
    """A point closer than the root of this to a Gaussian of the map is rejected. The release calls
    it a radius and compares it with squared distances."""
    removes_outliers: bool


PRESETS = {
    "replica": Preset(
        submap_points=600_000, frame_points=0, min_square_m2=1e-7, removes_outliers=False
    ),
    "tum": Preset(
        submap_points=100_000, frame_points=30_000, min_square_m2=1e-4, removes_outliers=True
    ),
    "scannetpp": Preset(
        submap_points=400_000, frame_points=100_000, min_square_m2=1e-8, removes_outliers=False
    ),
}


@trained_otherwise("colours fixed, 100 steps a mapped frame, separate submaps")
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class gaussian_slam(MapRule):
    """Gaussian-SLAM: a dense start of each submap, then every fifth frame what the map does not
    cover.

    Where a submap starts, every 50 mapped frames: the union of random pixels, of 50,000 pixels
    drawn in proportion to the image gradient, and of all edges (Canny 100/200 of the Euclidean
    gradient, dilated 2 x 2). In every fifth frame between: the pixels where

        A < 0.6   or   ( D^ > D  and  |D^ - D| > 40 median |D^ - D| )

    Depth is multiplied by 1.005; points close to a Gaussian of the map are rejected. Round
    Gaussians as large as the root mean square distance to their 3 nearest neighbours, new or in the
    map.

    Args:
        preset: Number of points, distance from existing Gaussians, outlier filter, as in the
            release: "replica" (600,000 points, 0.3 mm), "tum" (100,000, 1 cm, filter with 40
                neighbours and 2 standard deviations except
            in the first frame), "scannetpp" (400,000, 0.1 mm). Smaller images have fewer pixels;
            then all are taken.
        min_alpha: Pixels with a smaller accumulated opacity A are seeded. Release: 0.6.
        median_factor: How many medians a depth error must exceed. Release: 40.
        share: Share of these pixels that is drawn at random, 0..1; the sizes follow from the
            distances. Release: 1.
        restart: Whether a new submap is started densely, as in the release, whose submaps begin
            empty. False: only the first frame is; in one map, which is all there is here, a restart
            adds Gaussians where there are some.

    The release maps every fifth frame on Replica, every frame on TUM, every second one on ScanNet++
    (submaps of 100). D^ is the blended depth, not divided by A, as in the release: the gradient of
    the depth in its rasteriser (gaussian_rasterizer, ``backward.cu``) is that of the plain sum over
    alpha T z. Left out because the optimiser does it: fixed colours, pruning at opacity 0.1 or 0.5,
    the isotropy loss, separate optimisation of submaps. Neighbours outside the view count as well
    when points are rejected. Source: Yugay et al. 2023 (Gaussian-SLAM) and its released code, also
    LoopSplat's.
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
            mask = _start_of_submap(ctx, preset.submap_points)
            limit = 0
        else:
            mask = unmapped_pixels(ctx, self.min_alpha, self.median_factor)
            limit = preset.frame_points
        uv = ctx.pixels(mask)
        count = round(self.share * min(len(uv), limit or len(uv)))
        seeds = pushed_back(
            ctx,
            ctx.seeds_at(uv[draw_rows(ctx, len(uv), count)], 1.0),
            PUSH_BACK,
        )
        if ctx.has_map:
            distance = ctx.nearest(seeds.xyz_W, 1, "map").distance_m[:, 0]
            seeds = seeds[distance.square() >= preset.min_square_m2]
            if preset.removes_outliers:
                seeds = seeds[~outliers(seeds.xyz_W, 40, 2.0)]
        return sized_by_neighbours(ctx, seeds, "new and map")


def _start_of_submap(ctx: SeedContext, points: int) -> Bool[Tensor, "H W"]:
    """Random pixels, pixels on strong gradients, and edges."""
    has_depth = ctx.has_depth().flatten()
    mask = ctx.edges(100.0, 200.0, 2, euclidean=True).flatten() & has_depth
    candidate = has_depth.nonzero()[:, 0]
    mask[candidate[draw_rows(ctx, len(candidate), points)]] = True
    weight = gradient_length(luma(ctx.frame.rgb)).flatten() * has_depth
    mask[draw_weighted_rows(ctx, weight, GRADIENT_POINTS)] = True
    return mask.view(ctx.camera.height, ctx.camera.width)


@trained_otherwise("parts of keyframes that have changed are ignored, by masks of objects")
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class game(KeyframeRule):
    """GaME: in keyframes, Gaussians where the map is empty, behind or of another colour; stale ones
    are removed.

    Half of the pixels with depth where

           A < 0.3
        or ( D^ > D  and  |D^ - D| > 40 median |D^ - D| )
        or mean over R, G, B of |C^ - C| > 0.1

    with the map's picture C^ over white. Round Gaussians of standard deviation sqrt(0.05) d, with
    the root mean square distance d to the 3 nearest neighbours, new or in the map. After the last
    gradient step of a frame the Gaussians are removed that lie in front of the measured depth by
    more than 5 cm at a pixel whose colour is wrong by more than 0.1 (the scene has changed there),
    and after half of the steps and the last one those with an opacity below 0.1.

    Args:
        min_alpha: Pixels with a smaller accumulated opacity A are seeded. Release: 0.3.
        median_factor: How many medians a depth error must exceed. Release: 40.
        colour_error: Mean absolute colour error (0..1) above which a pixel is seeded, and a
            Gaussian may be stale. Release: 0.1.
        stale_m: How far in front of the measured depth a stale Gaussian lies, metres. Release:
            0.05.
        min_opacity: Gaussians with a lower opacity are removed. Release: 0.1.
        share: Share of the pixels that is drawn at random, 0..1; the sizes follow from the
            distances. The release takes every second one: 0.5.

    Left out: masks of objects from a segmentation network, by which the release also removes the
    rest of an object, and ignores stale parts of keyframes. Every 5th recorded frame is a keyframe
    unless the settings say otherwise; the release's numbers were read in a port of its code to the
    CPU. Source: Yugay et al. 2026 (GaME, arXiv 2506.06909) and its released code.
    """

    min_alpha: float = 0.3
    median_factor: float = 40.0
    colour_error: float = 0.1
    stale_m: float = 0.05
    min_opacity: float = 0.1
    share: float = 0.5

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The Gaussians of one keyframe."""
        mask = unmapped_pixels(ctx, self.min_alpha, self.median_factor)
        if ctx.has_map:
            view = ctx.render()
            over_white = view.rgb + (1 - view.alpha)[..., None]
            mask |= (over_white - ctx.frame.rgb).abs().mean(dim=-1) > self.colour_error
        uv = drawn_pixels(ctx, mask, self.share)
        return sized_by_neighbours(ctx, ctx.seeds_at(uv, 1.0), "new and map", factor=0.05**0.5)

    def after_step(
        self,
        ctx: SeedContext,
        stats: StepStats,
        memory: dict[str, Any],
    ) -> Edit | None:
        """Remove transparent Gaussians and, after the last step, stale ones."""
        step = stats.step_in_frame
        last = stats.steps_in_frame
        if stats.stage != "online" or step not in (last // 2 + 1, last):
            return None
        keep = ctx.map.opacity >= self.min_opacity
        if step == last and len(ctx.map):
            wrong = (ctx.render().rgb - ctx.frame.rgb).abs().mean(dim=-1) > self.colour_error
            keep &= ~in_front(ctx, self.stale_m, wrong)
        return None if keep.all() else Edit(keep=keep)


@trained_otherwise("densified, opacities of floating Gaussians lowered")
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class gs_slam(KeyframeRule):
    """GS-SLAM: in keyframes, Gaussians wherever the map does not cover the view, or its depth is
    wrong.

    In the first frame half of the pixels with depth, drawn at random; in later keyframes those
    where A < tau_T or |D^ - D| > tau_D. Round Gaussians, as large as the root mean square distance
    to their 3 nearest neighbours, new or in the map.

    Args:
        first_share: Share of the pixels of the first frame. Publication: half.
        min_alpha: tau_T: pixels with a smaller accumulated opacity A are seeded; 0.5 is chosen
            here.
        depth_error: tau_D, metres: larger errors of the blended depth are seeded; 0.1 is chosen
            here.
        share: Share of all these pixels that is drawn at random, 0..1; the sizes follow from the
            distances. Publication: 1.
        opacity: The publication presets one value; 0.5 is chosen here.

    The three values chosen here cannot be compared with the authors': the paper leaves its numbers
    to a supplement, and no code was released.

    Left out because the optimiser does it: a Gaussian in front of the measured depth by more than
    gamma gets eta times its opacity; splitting and cloning. Every 5th recorded frame is a keyframe
    unless the settings say otherwise. Source: Yan et al. 2024 (GS-SLAM), the paper alone.
    """

    first_share: float = 0.5
    min_alpha: float = 0.5
    depth_error: float = 0.1
    share: float = 1.0
    opacity: float = 0.5

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The points of one keyframe."""
        mask = None
        share = self.share * self.first_share
        if ctx.has_map:
            mask = (ctx.render().alpha < self.min_alpha) | (depth_error_m(ctx) > self.depth_error)
            share = self.share
        seeds = ctx.seeds_at(drawn_pixels(ctx, mask, share), 1.0, opacity=self.opacity)
        return sized_by_neighbours(ctx, seeds, "new and map")


@trained_otherwise("anisotropy in the loss, split once, pruned")
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class cg_slam(MapRule):
    """CG-SLAM: every 30 frames, a Gaussian for each pixel that the map does not cover.

    Each pixel with depth where A < 0.5. Round Gaussians as large as the root mean square distance
    to their 3 nearest neighbours, new or in the map.

    Args:
        min_alpha: Pixels with a smaller accumulated opacity A are seeded. Release: 0.5.
        share: Share of the pixels that is drawn at random, 0..1; the sizes follow from the
            distances. Release: 1.

    In the release only visible Gaussians of the map count as neighbours; here all do, of which the
    nearest 3 are almost always visible. Left out because the optimiser does it: one step of
    splitting and pruning halfway (opacity 0.005, 20 pixels), the anisotropy loss, and uncertainty.
    The release maps every 30th frame on Replica. Source: Hu et al. 2024 (CG-SLAM) and its released
    code.
    """

    min_alpha: float = 0.5
    share: float = 1.0

    when: ClassVar[When] = every(30)

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The points of one mapped frame."""
        mask = ctx.render().alpha < self.min_alpha if ctx.has_map else None
        uv = drawn_pixels(ctx, mask, self.share)
        return sized_by_neighbours(ctx, ctx.seeds_at(uv, 1.0), "new and map")


@trained_otherwise("flat Gaussians, of which only unstable ones with large errors are optimised")
@seeding_rule
def vings(
    ctx: SeedContext,
    *,
    share: float = 0.13,
    max_alpha: float = 0.98,
    median_factor: float = 10.0,
    colour_error: float = 0.1,
    thickness: float = 0.1,
    as_released: bool = True,
) -> Seeds:
    """VINGS-Mono: as many discs as there are pixels with errors, drawn from all pixels, of random
    orientation.

    Their number is ``share`` times the number of the image's pixels where

        A <= 0.98   or   |D^ - D| > 10 median |D^ - D|   or   sum over R, G, B of |C^ - C| > 0.1

    Their size is the root mean square distance to the 3 nearest new ones, the same on both axes of
    the disc, their opacity 0.8, in the first frame 0.1.

    Args:
        ctx: Frame and Gaussian map.
        share: Number of Gaussians as a share of the pixels that the test chooses. The release makes
            40,000 Gaussians if all pixels are chosen, whatever the size of the image; that is 0.13
            of 640 x 480 pixels.
        max_alpha: Pixels with an accumulated opacity A up to this are chosen. Release: 0.98.
        median_factor: How many medians a depth error must exceed, on either side. Release: 10.
        colour_error: Sum of the absolute colour errors (0..1 each) above which a pixel is chosen.
            Release: 0.1.
        thickness: Third standard deviation as a share of the other two. The release has flat
            Gaussians without one; 0.1 is chosen here.
        as_released: The released code draws the points from all pixels with depth, so the test
            decides only how many there are. False draws them from the chosen pixels.

    Left out because the optimiser does it: pruning by size in the image, and training only unstable
    Gaussians with large errors. VINGS estimates depth; here it is measured. Its renderer divides
    the depth by A (``scripts/gaussian/gaussian_base.py``, ``render_raw``); here D^ is not divided,
    so that the depth test also chooses pixels that the map covers only in part.
    Source: the released code of VINGS-Mono.
    """
    mask = has_depth = ctx.has_depth()
    if ctx.has_map:
        view = ctx.render()
        wrong = (view.rgb - ctx.frame.rgb).abs().sum(dim=-1) > colour_error
        depth = unmapped_pixels(ctx, 0.0, median_factor, sides="both")
        mask = has_depth & ((view.alpha <= max_alpha) | depth | wrong)
    count = round(share * int(mask.sum()))
    uv = ctx.pixels(has_depth if as_released else mask)
    uv = uv[draw_rows(ctx, len(uv), count)]
    balls = sized_by_neighbours(ctx, ctx.seeds_at(uv, 1.0, opacity=0.8 if ctx.has_map else 0.1))
    generator = ctx.generator
    quat = torch.randn(len(balls), 4, generator=generator, device=generator.device).to(balls.quat)
    return dataclasses.replace(
        balls, quat=quaternion.normalise(quat), scale_m=thin(balls.scale_m, thickness)
    )
