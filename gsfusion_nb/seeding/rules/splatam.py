"""SplaTAM's rule and those derived from it: Gaussians of one pixel where the map covers nothing or
is wrong."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ...gaussians import Edit
from ...geometry.spherical_harmonics import SH_C0
from ...render import render_forward
from ...types import Seeds
from ..context import SeedContext
from ..coverage import depth_error_m, unmapped_pixels
from ..discs import as_discs
from ..draws import draw_rows, drawn_pixels, one_pixel_seeds, pixel_radius
from ..map_queries import map_params, surface_inputs
from ..map_rule import MapRule, StepStats
from ..rule import seeding_rule, trained_otherwise
from ..shapes import pushed_back


@trained_otherwise("60 steps a frame on colour and depth, pruned")
@seeding_rule
def splatam(
    ctx: SeedContext,
    *,
    min_alpha: float = 0.5,
    median_factor: float = 50.0,
    share: float = 1.0,
    every_px: int = 1,
    median_of: Literal["all", "measured"] = "all",
) -> Seeds:
    """SplaTAM: a Gaussian of one pixel wherever the map does not cover the view, or lies behind the
    measured surface.

    Round, with standard deviation z / f, f = (fx + fy) / 2, for each pixel with depth where

        A < 0.5   or   ( D^ > D  and  |D^ - D| > 50 median |D^ - D| )

    with the map's accumulated opacity A and its blended depth D^, which is not divided by A. In the
    first frame every pixel with depth.

    Args:
        ctx: Frame and Gaussian map.
        min_alpha: Pixels with a smaller A are seeded. Publication and release: 0.5.
        median_factor: How many medians a depth error must exceed. Publication and release: 50.
        share: Share of the pixels that is drawn at random, 0..1, with sizes 1 / sqrt(share) times
            as large. Release: 1.
        every_px: Only every n-th pixel of every n-th row, n times as large. Release: 1; its variant
            SplaTAM-S: 2.
        median_of: The median over "all" pixels counts missing depth as an error of 0, as in the
            release.

    Left out because the optimiser does it: pruning (``splatam_like`` has it), and tracking. Colours
    are stored as here, without view dependence.
    Source: Keetha et al. 2024 (SplaTAM) and its released code.
    """
    mask = unmapped_pixels(ctx, min_alpha, median_factor, median_of=median_of)
    return one_pixel_seeds(ctx, mask, share=share, every_px=every_px)


RADIUS = "scene_radius_m"
PRUNED_AFTER = (1, 21)
"""Steps of a frame after which Gaussians are removed: iterations 0 and 20, counted from 0."""


@trained_otherwise("60 steps a frame")
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class splatam_like(MapRule):
    """SplaTAM-like mapping in GSFusion's frame step: seeding, losses, learning rates, number of
    steps, pruning.

    Seeds as the rule ``splatam``. Loss: depth L1 + 0.5 (0.8 L1 + 0.2 (1 - SSIM)), here twice that.
    Adam's rates: centres 1e-4, colours 0.0025, opacity logits 0.05, log-scales 0.001, rotations
    0.001. 60 steps a frame. After the 1st and the 21st step of a frame, Gaussians with an opacity
    below 0.005 or a standard deviation above 0.1 of the scene's radius are removed. The radius is a
    third of the largest depth of the first frame.

    Args:
        min_alpha: As for ``splatam``.
        median_factor: As for ``splatam``.
        share: As for ``splatam``.
        min_opacity: Gaussians with a lower opacity are removed. Release: 0.005.
        max_extent: Largest standard deviation as a share of the scene's radius. Release: 0.1. With
            a ``share`` below 1, 1 / sqrt(share) times that, as the sizes of the seeds.
        radius_share: The scene's radius as a share of the largest depth of the first frame.
            Release: 1/3 (TUM: 1/2).

    The release takes 30 steps a frame on TUM. It draws the views of its steps from frames that
    overlap; here, on a keyframe (every 5th frame) all 60 steps are on the frame, on others 30 are,
    and up to 30 on earlier keyframes drawn at random. Colours are SH coefficients of degree 0, and
    their rate is divided by the factor between the two. There are no steps after the scan. Left
    out: tracking. Source: Keetha et al. 2024 (SplaTAM) and its released code.
    """

    min_alpha: float = 0.5
    median_factor: float = 50.0
    share: float = 1.0
    min_opacity: float = 0.005
    max_extent: float = 0.1
    radius_share: float = 1 / 3

    overrides: ClassVar[Mapping[str, Any]] = {
        "sh_degree": 0,
        "keyframe_every": 5,
        "optim__lr_xyz": 1e-4,
        "optim__lr_sh_dc": 2.5e-3 / SH_C0,
        "optim__lr_opacity_logit": 0.05,
        "optim__lr_log_scale": 1e-3,
        "optim__lr_quat": 1e-3,
        "optim__depth_weight": 2.0,
        "optim__online_ssim_weight": 0.2,
        "optim__keyframe_iterations": 60,
        "optim__frame_iterations": 30,
        "optim__random_keyframe_iterations": 30,
        "optim__global_iterations": 0,
    }

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """SplaTAM's seeds of one frame."""
        if RADIUS not in memory:
            memory[RADIUS] = self.radius_share * float((ctx.frame.depth_m * ctx.has_depth()).max())
        return splatam(
            ctx, min_alpha=self.min_alpha, median_factor=self.median_factor, share=self.share
        )

    def after_step(
        self,
        ctx: SeedContext,
        stats: StepStats,
        memory: dict[str, Any],
    ) -> Edit | None:
        """Remove transparent and large Gaussians."""
        if stats.stage != "online" or stats.step_in_frame not in PRUNED_AFTER:
            return None
        large = ctx.map.scale_m.amax(dim=1) > self.max_extent * memory[RADIUS] / self.share**0.5
        keep = (ctx.map.opacity >= self.min_opacity) & ~large
        return None if keep.all() else Edit(keep=keep)


@trained_otherwise("densified and pruned every 50 steps")
@seeding_rule
def mm3dgs(
    ctx: SeedContext,
    *,
    method: Literal["own", "splatam"] = "own",
    min_alpha: float = 0.5,
    share: float = 1.0,
    median_of: Literal["all", "measured"] = "all",
) -> Seeds:
    """MM3DGS: a Gaussian of one pixel wherever the map does not cover the view, or its depth is
    wrong by far.

    Round, with standard deviation z / f, f = (fx + fy) / 2, for each pixel with depth where A < 0.5
    or |D^ - D| > 10 median |D^ - D|, whether the measured surface lies in front of the map's or
    behind it.

    Args:
        ctx: Frame and Gaussian map.
        method: "own": as above; "splatam": the other method of the release: 50 medians, and only in
            front.
        min_alpha: Pixels with a smaller accumulated opacity are seeded. Release: 0.5.
        share: Share of the pixels that is drawn at random, 0..1, with sizes 1 / sqrt(share) times
            as large. Release: 1.
        median_of: The median over "all" pixels counts missing depth as an error of 0, as in the
            release.

    Left out because the optimiser does it: 3DGS's densification and pruning every 50 steps. D^ is
    the blended depth that is not divided by A, as in the release.
    Source: the released code of MM3DGS.
    """
    own = method == "own"
    mask = unmapped_pixels(
        ctx,
        min_alpha,
        10.0 if own else 50.0,
        sides="both" if own else "in front",
        median_of=median_of,
    )
    return one_pixel_seeds(ctx, mask, share=share)


@trained_otherwise("flat Gaussians in local maps, pruned")
@seeding_rule
def gaus_slam(
    ctx: SeedContext,
    *,
    min_alpha: float = 0.6,
    median_factor: float = 50.0,
    share: float = 1.0,
    thickness: float = 0.1,
    median_of: Literal["all", "measured"] = "all",
) -> Seeds:
    """GauS-SLAM: a disc of one pixel wherever the map does not cover the view, or lies behind the
    measured surface.

    Thin along the normal of the depth image, for each pixel with depth where

        A < 0.6   or   ( D^ > D  and  |D^ - D| > 50 median |D^ - D| )

    Args:
        ctx: Frame and Gaussian map.
        min_alpha: Pixels with a smaller accumulated opacity A are seeded. Release: 0.6.
        median_factor: How many medians a depth error must exceed. Release: 50.
        share: Share of the pixels that is drawn at random, 0..1, with sizes 1 / sqrt(share) times
            as large. Release: 1.
        thickness: Third standard deviation as a share of the other two. The release has flat
            Gaussians without one; 0.1 is chosen here.
        median_of: The median over "all" pixels counts missing depth as an error of 0, as in the
            release.

    A disc without a normal (at edges and borders of the depth image) faces the camera. D^ is the
    blended depth divided by A, as in the release (``use_weight_norm``). Left out: its choice of
    keyframes (more than 1 % of the pixels have A < 0.5), pruning (opacity below 0.05, mean scale
    below 0.0005 or above 0.1), local maps, and growth into depth holes, which the release has
    switched off. Source: the released code of GauS-SLAM.
    """
    mask = unmapped_pixels(ctx, min_alpha, median_factor, median_of=median_of, divided=True)
    uv = drawn_pixels(ctx, mask, share)
    seeds = ctx.seeds_at(uv, pixel_radius(ctx, share))
    return as_discs(ctx, seeds, ctx.values_at(ctx.normals_W(), uv), thickness)


PUSH_BACK = 1.005
"""Depth is multiplied by this before points are placed and sized."""
QUARTERS = torch.tensor([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]])


@trained_otherwise(
    "centres and rotations fixed, 100 steps a frame, a map of its own for each 40 frames"
)
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class vtgaussian(MapRule):
    """VTGaussian-SLAM: SplaTAM's pixels, four finer ones besides where the colour varies; Gaussians
    that do not move.

    A round Gaussian of one pixel for each pixel with depth where A < 0.5, or D^ > D and |D^ - D| >
    50 medians. Near edges of the picture (Canny 50/200 of the Euclidean gradient, dilated 3 x 3)
    there are four more of half a pixel, at the centres of its quarters. Depth is multiplied by
    1.005. Centres and rotations are not optimised ("view-tied").

    Args:
        min_alpha: Pixels with a smaller accumulated opacity A are seeded. Release: 0.5.
        median_factor: How many medians a depth error must exceed. Release: 50.
        fine: Whether there are finer Gaussians near edges. Release: True.
        share: Share of the Gaussians that is drawn at random, 0..1, with sizes 1 / sqrt(share)
            times as large. Release:
            1.
        median_of: The median over "all" pixels counts missing depth as an error of 0, as in the
            release.

    The release reads depth and colour of the quarters from images of twice the size; here they are
    those of the pixel. Left out: sections of 40 frames, each with its own Gaussians, and tracking
    against them. Source: Hu and Han 2025 (VTGaussian-SLAM) and its released code.
    """

    min_alpha: float = 0.5
    median_factor: float = 50.0
    fine: bool = True
    share: float = 1.0
    median_of: Literal["all", "measured"] = "all"

    overrides: ClassVar[Mapping[str, Any]] = {"optim__lr_xyz": 0.0, "optim__lr_quat": 0.0}

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """Coarse and fine Gaussians of one frame."""
        mask = unmapped_pixels(ctx, self.min_alpha, self.median_factor, median_of=self.median_of)
        coarse = one_pixel_seeds(ctx, mask, share=self.share)
        if not self.fine:
            return pushed_back(ctx, coarse, PUSH_BACK)
        uv = ctx.pixels(mask & ctx.edges(50.0, 200.0, 3, euclidean=True))
        uv = (uv[:, None] + QUARTERS.to(uv)).reshape(-1, 2)
        uv = uv[draw_rows(ctx, len(uv), round(self.share * len(uv)))]
        fine = ctx.seeds_at(uv, 0.5 * pixel_radius(ctx, self.share))
        return pushed_back(ctx, Seeds.cat([coarse, fine]), PUSH_BACK)


@trained_otherwise("50 steps a frame on colour and depth")
@seeding_rule
def hf_slam(
    ctx: SeedContext,
    *,
    min_alpha: float = 0.5,
    colour_error: float = 0.6,
    relative_depth_error: float = 0.1,
    share: float = 1.0,
    as_released: bool = True,
) -> Seeds:
    """HF-SLAM: a Gaussian of one pixel wherever the map does not cover the view, or its colour or
    depth is wrong.

    Round, with standard deviation z / f, f = (fx + fy) / 2, for each pixel with depth where

        A < 0.5   or   mean over R, G, B of |C^ - C| > 0.6   or   |D^ - D| / D > 0.1

    with the map's accumulated opacity A, picture C^ and blended depth D^ (not divided by A, as in
    SplaTAM, from which HF-SLAM is derived). Unlike SplaTAM's, the depth test is relative to the
    distance and has no median.

    The release sums the opacity with the transmittance behind each Gaussian, A = sum alpha_k
    T_{k+1}, T_{k+1} = T_k (1 - alpha_k), in place of alpha_k T_k. So one Gaussian adds at most
    0.25, and opaque ones next to nothing: pixels that are covered by opaque Gaussians are seeded
    again in every frame.

    Args:
        ctx: Frame and Gaussian map.
        min_alpha: Pixels with a smaller A are seeded. Release: 0.5.
        colour_error: Mean absolute colour error (0..1) above which a pixel is seeded. Release: 0.6.
        relative_depth_error: Depth error as a share of the depth above which a pixel is seeded.
            Release: 0.1.
        share: Share of the pixels that is drawn at random, 0..1, with sizes 1 / sqrt(share) times
            as large. Release: 1.
        as_released: A as the release sums it; False: as everywhere else, sum alpha_k T_k.

    The release neither prunes nor densifies; so nothing of its optimiser is left out.
    Source: the released code of HF-SLAM.
    """
    mask = ctx.has_depth()
    if ctx.has_map:
        view = ctx.render()
        colour = (view.rgb - ctx.frame.rgb).abs().mean(dim=-1) > colour_error
        depth = depth_error_m(ctx) > relative_depth_error * ctx.frame.depth_m
        alpha = alpha_behind(ctx) if as_released and surface_inputs(ctx) is None else view.alpha
        mask = mask & ((alpha < min_alpha) | colour | depth)
    return one_pixel_seeds(ctx, mask, share=share)


def alpha_behind(ctx: SeedContext) -> Float[Tensor, "H W"]:
    """sum_k alpha_k T_{k+1}, with the light that is left behind each Gaussian in place of in front
    of it. [H, W]"""
    screen = render_forward(
        map_params(ctx),
        ctx.camera,
        ctx.frame.T_WC,
        with_indices=False,
        near_m=ctx.reading.near_plane_m,
    )[1].screen
    A = torch.zeros_like(ctx.frame.depth_m)
    for tile in range(screen.tiles.tiles_x * screen.tiles.tiles_y):
        x, y = screen.pixels_of(tile, ctx.camera)
        blend = screen.blend(tile, x, y)
        A[y, x] = (blend.weight * (1 - blend.alpha)).sum(dim=0)
    return A
