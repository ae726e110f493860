"""Rules that seed keyframes sparsely, whatever the map's picture shows."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch

from ...gaussians import Edit
from ...types import Seeds
from ..context import SeedContext
from ..discs import as_discs
from ..draws import draw_rows, drawn_pixels
from ..image_features import orb_corners
from ..map_rule import KEYFRAMES, KeyframeRule, MapRule, StepStats, When
from ..points import first_in_voxel, restart_statistics
from ..rule import seeding_rule, trained_otherwise
from ..shapes import sized_by_neighbours

PRESETS = {"replica": (1 / 64, 0.05), "tum": (1 / 128, 0.01)}
"""Share of a keyframe's pixels; point size."""
FIRST_SHARE = 1 / 32
MAX_POINT_SIZE = 0.05
MIN_COLOUR_SUM = 0.01


@trained_otherwise("isotropy in the loss, densified and pruned every 150 steps")
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class monogs(KeyframeRule):
    """MonoGS: in keyframes, a small random share of all pixels, whatever is mapped.

    1/64 of the pixels with depth, in the first frame 1/32. Round Gaussians of standard deviation
    sqrt(d^2 p): d^2 is the mean squared distance to the 3 nearest of the new points, p = min(0.05,
    c median(D)) the point size. Black pixels (R + G + B <= 0.01) are left out.

    Args:
        preset: "replica": 1/64, c = 0.05; "tum": 1/128, c = 0.01, as in the release for these data
            sets.
        density: Multiplies the number of points; the sizes follow from their distances. Release: 1.

    The median of the depth is taken over the pixels that have depth. Left out because the optimiser
    does it: 3DGS's densification, opacity resets, covisibility pruning and the isotropy loss
    (``monogs_like`` has some of it). MonoGS chooses keyframes by overlap and motion, at least every
    4th frame (Replica) or 5th (TUM); here every 5th mapped frame is one unless the settings say
    otherwise. Its mode without depth is left out. Source: Matsuki et al. 2024 (MonoGS) and its
    released code.
    """

    preset: Literal["replica", "tum"] = "replica"
    density: float = 1.0

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The points of one keyframe."""
        share, c = PRESETS[self.preset]
        share = self.density * (share if ctx.has_map else FIRST_SHARE)
        uv = ctx.pixels()
        uv = uv[draw_rows(ctx, len(uv), int(share * len(uv)))]
        seeds = ctx.seeds_at(uv, 1.0)
        seeds = seeds[seeds.rgb.sum(dim=1) > MIN_COLOUR_SUM]
        if len(seeds) == 0:
            return seeds
        point_size = min(
            MAX_POINT_SIZE,
            c * float(ctx.frame.depth_m[ctx.has_depth()].median()),
        )
        return sized_by_neighbours(ctx, seeds, factor=point_size**0.5)


LARGEST = "largest_radius_px"
"""For each row: its largest radius in a picture since the last densification."""
SMALL_SHARE = 0.01
LARGE_SHARE = 0.1
"""3DGS: Gaussians below the first share of the extent are cloned and not split; above the second
they are removed."""
RESET_OPACITY = 0.4


@trained_otherwise("30 steps a frame")
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class monogs_like(MapRule):
    """MonoGS-like mapping in GSFusion's frame step: seeding in keyframes, isotropy loss, 3DGS's
    densification.

    Seeds as the rule ``monogs``. Every 150 steps, Gaussians whose centre has a mean gradient in the
    image of at least 2e-4 are cloned if they are smaller than 0.01 of the extent (1 m), else split;
    and Gaussians with an opacity below 0.7, larger than 0.1 of the extent, or with a radius above
    20 pixels in a picture since the last time are removed. Every 2001 steps, Gaussians that are not
    visible get the opacity 0.4.

    Args:
        preset: As for ``monogs``.
        density: As for ``monogs``.
        densify_every: Number of steps between densifications. Release: 150.
        min_gradient: Mean gradient from which on Gaussians are densified, in units of half the
            image. Release: 2e-4.
        min_opacity: Gaussians with a lower opacity are removed. Release: 0.7.
        extent_m: Extent of the scene, metres. Release: 1.
        max_radius_px: Largest radius in a picture, pixels. Release: 20.
        reset_every: Number of steps between resets of the opacity; 0: never. Release: 2001.

    The weight of the isotropy loss is 10. Here every 5th recorded frame is a keyframe, with 30
    steps on each frame (on others than keyframes 20, and up to 10 on earlier keyframes), so that
    150 steps fall on a keyframe; these numbers are chosen here. "Not visible" is judged by the view
    of that step; a radius reaches to where alpha is 1/255. Left out: the window of covisible
    keyframes, its loss on depth (0.05, beside 0.95 of the colour), pruning by covisibility, which
    takes effect only without depth, and 26,000 steps of colour refinement after the scan. Source:
    Matsuki et al. 2024 (MonoGS) and its released code; Kerbl et al. 2023 (3DGS), section 5.2.
    """

    preset: Literal["replica", "tum"] = "replica"
    density: float = 1.0
    densify_every: int = 150
    min_gradient: float = 2e-4
    min_opacity: float = 0.7
    extent_m: float = 1.0
    max_radius_px: float = 20.0
    reset_every: int = 2001

    when: ClassVar[When] = KEYFRAMES
    needs: ClassVar[frozenset[str]] = frozenset({"image_gradients"})
    overrides: ClassVar[Mapping[str, Any]] = {
        "sh_degree": 0,
        "keyframe_every": 5,
        "optim__isotropy_weight": 10.0,
        "optim__keyframe_iterations": 30,
        "optim__frame_iterations": 20,
        "optim__random_keyframe_iterations": 10,
    }

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """MonoGS's seeds of one keyframe."""
        return monogs(preset=self.preset, density=self.density).seeds(ctx, memory)

    def after_step(
        self,
        ctx: SeedContext,
        stats: StepStats,
        memory: dict[str, Any],
    ) -> Edit | None:
        """Densify, prune and reset when it is time to."""
        assert stats.visible is not None
        assert stats.radius_px is not None
        largest = ctx.gaussians.row_memory(LARGEST)
        torch.maximum(largest, stats.radius_px, out=largest)
        if stats.stage != "online":
            return None
        densify = stats.step % self.densify_every == 0
        reset = self.reset_every > 0 and stats.step % self.reset_every == 0
        is_hidden = ~stats.visible
        settings = (
            {"opacity": (is_hidden, torch.full_like(ctx.map.opacity[is_hidden], RESET_OPACITY))}
            if reset
            else {}
        )
        if not densify:
            return Edit(set=settings) if settings else None
        edit = self._densification(ctx, largest > self.max_radius_px, settings)
        largest.zero_()
        restart_statistics(ctx.gaussians)
        return edit

    def _densification(
        self,
        ctx: SeedContext,
        wide: torch.Tensor,
        settings: dict[str, Any],
    ) -> Edit:
        """Clone, split and remove as 3DGS does, where copies of what is removed would be removed as
        well."""
        size = ctx.map.scale_m.amax(dim=1)
        keep = (ctx.map.opacity >= self.min_opacity) & (size <= LARGE_SHARE * self.extent_m) & ~wide
        assert ctx.map.image_gradient is not None
        grows = keep & (ctx.map.image_gradient >= self.min_gradient)
        small = size <= SMALL_SHARE * self.extent_m
        return Edit(set=settings, clone=grows & small, split=grows & ~small, keep=keep)


@trained_otherwise("a pyramid of pictures, densified")
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class photo_slam(KeyframeRule):
    """Photo-SLAM: in keyframes, a Gaussian for each ORB corner with depth, whatever is mapped.

    Round Gaussians as large as the root mean square distance to their 3 nearest neighbours among
    the new ones; opacity 0.1.

    Args:
        corners: Number of corners per keyframe, at most. The release takes all those of its
            tracker; 1000 is usual.
        max_depth_m: Corners farther away are left out, metres; 0: no limit. Nearer than
            ``ctx.near_m`` are left out, too.

    Left out: the map points of ORB-SLAM3, which the release seeds as well; the delay of 10
    keyframes until new points are added; 3DGS's densification and the training on an image pyramid,
    which belong to the optimiser. The corners here are not spread over the image as ORB-SLAM3
    spreads them. Every 5th recorded frame is a keyframe unless the settings say otherwise.
    Source: Huang et al. 2024 (Photo-SLAM) and its released code ("inactive geometry
    densification").
    """

    corners: int = 1000
    max_depth_m: float = 0.0

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The corners of one keyframe."""
        uv = orb_corners(ctx.frame, self.corners)
        if self.max_depth_m > 0:
            uv = uv[ctx.values_at(ctx.frame.depth_m, uv) <= self.max_depth_m]
        return sized_by_neighbours(ctx, ctx.seeds_at(uv, 1.0, opacity=0.1))


OPACITY = 0.999
MIN_DEPTH_M = 0.1
MAX_DEPTH_M = 10.0
MAX_OF_MEAN = 3.0


@trained_otherwise("flat Gaussians, cloned and split where the error is large, pruned")
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class two_dgs_slam(KeyframeRule):
    """2DGS-SLAM: in keyframes, discs for random pixels in voxels of 5 cm that hold no Gaussian yet.

    A random 10 % of the pixels with depth (0.1 to 10 m), of those the ones in voxels of 5 cm that
    hold no Gaussian of the map. Discs along the normals of the depth image, as large as the root
    mean square distance to their 3 nearest neighbours among all drawn points, also those in
    occupied voxels, but at most 3 times the mean of these.

    Args:
        share: Share of the pixels that is drawn at random, 0..1. Release: 0.1.
        voxel_size_m: Edge length of a voxel, metres. Release: 0.05.
        one_per_voxel: Of the new points that share a voxel keep only the first. As far as known the
            release keeps all, because it looks up only voxels that were occupied before.
        thickness: Third standard deviation as a share of the other two. The release has flat
            Gaussians without one; 0.1 is chosen here.
        as_released: The release uses its setting ``initial_opacity: 0.999`` directly as a logit, so
            the opacity is sigmoid(0.999) = 0.73. False: 0.999.

    Depth below ``ctx.near_m`` counts as missing here. Left out because the optimiser does it:
    pruning by contribution, splitting and cloning where errors are large. Every 5th recorded frame
    is a keyframe unless the settings say otherwise.
    Source: the released code of 2DGS-SLAM (PRBonn).
    """

    share: float = 0.1
    voxel_size_m: float = 0.05
    one_per_voxel: bool = False
    thickness: float = 0.1
    as_released: bool = True

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The discs of one keyframe."""
        in_range = (ctx.frame.depth_m >= MIN_DEPTH_M) & (ctx.frame.depth_m <= MAX_DEPTH_M)
        uv = drawn_pixels(ctx, in_range, self.share)
        opacity = float(torch.tensor(OPACITY).sigmoid()) if self.as_released else OPACITY
        seeds = ctx.seeds_at(uv, 1.0, opacity=opacity)
        free = ~ctx.occupied(seeds.xyz_W, self.voxel_size_m)
        if self.one_per_voxel:
            free &= first_in_voxel(seeds.xyz_W, self.voxel_size_m)
        # sized before the voxel filter
        seeds = sized_by_neighbours(ctx, seeds, max_of_mean=MAX_OF_MEAN)[free]
        return as_discs(
            ctx,
            seeds,
            ctx.values_at(ctx.normals_W(), uv[free]),
            self.thickness,
        )
