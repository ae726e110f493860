"""Rules that draw pixels with a probability given by the difference of frame and map's picture."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...gaussians import Edit
from ...geometry import se3
from ...geometry.spherical_harmonics import SH_C0
from ...render import render
from ...types import Seeds
from ..context import SeedContext
from ..draws import draw_rows, draw_weighted_rows
from ..image_features import absolute_laplacian, disc_blur, without_detail
from ..map_rule import KeyframeRule, MapRule, StepStats
from ..rule import seeding_rule, trained_otherwise
from ..shapes import sized_by_neighbours

OPACITY = 0.1
MIN_OPACITY = 0.005
PRUNE_EVERY = 100


@trained_otherwise("on all pictures of a scan at once, at the depth of an Instant-NGP model")
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class cone_gs(MapRule):
    """ConeGS: pixels drawn with a probability in proportion to their colour error, as wide as the
    cone of a pixel.

    A pixel seen at depth z is z / fx wide and z / fy high. A new Gaussian lies on the ray of its
    pixel, at the measured depth, is round, and its standard deviation is the mean of the two, the
    diameter of the pixel's cone. Pixels are drawn without replacement with weights mean |C^ - C|
    over R, G, B, whatever the map's geometry is. Opacity 0.1. Every 100 gradient steps, Gaussians
    with an opacity up to 0.005 are removed.

    The first frame gives the initial Gaussians: pixels drawn at random, as large as the root mean
    square distance to their 3 nearest neighbours.

    Args:
        share: Share of the pixels of the first frame. In later frames the number of Gaussians is
            this share of the sum of the errors (0..1 each), so a wrong frame gets many and a right
            one few. Chosen here: the release adds 2 % of the Gaussians in 100 steps on all frames,
            while here each frame comes once.
        max_points: No more Gaussians than this; 0: no limit. The release's budget.

    Depth is measured here; the release trains an Instant-NGP model for it, whose colours it takes,
    too. Left out: its penalty of 0.0002 times the mean opacity logit, and its learning rates.
    Source: Baranowski et al. 2025 (ConeGS, arXiv 2511.06810) and its released code.
    """

    share: float = 0.05
    max_points: int = 0

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The Gaussians of one frame."""
        if not ctx.has_map:
            uv = ctx.pixels()
            uv = uv[
                draw_rows(
                    ctx,
                    len(uv),
                    self._room(ctx, round(self.share * len(uv))),
                )
            ]
            return sized_by_neighbours(ctx, ctx.seeds_at(uv, 1.0, opacity=OPACITY))
        error = (ctx.render().rgb - ctx.frame.rgb).abs().mean(dim=-1)[ctx.has_depth()]
        uv = ctx.pixels()[
            draw_weighted_rows(
                ctx,
                error,
                self._room(ctx, round(self.share * float(error.sum()))),
            )
        ]
        # seeds_at divides by fx
        return ctx.seeds_at(uv, (1 + ctx.camera.fx / ctx.camera.fy) / 2, opacity=OPACITY)

    def after_step(
        self,
        ctx: SeedContext,
        stats: StepStats,
        memory: dict[str, Any],
    ) -> Edit | None:
        """Remove transparent Gaussians, where it is time."""
        if stats.step % PRUNE_EVERY:
            return None
        keep = ctx.map.opacity > MIN_OPACITY
        return None if keep.all() else Edit(keep=keep)

    def _room(self, ctx: SeedContext, count: int) -> int:
        room = self.max_points - (len(ctx.map) if ctx.has_map else 0)
        return min(count, max(room, 0)) if self.max_points else count


BLUR_PX = 3.5
"""The release's disc has radius 3: the pixels whose centres are within 3.5."""
FAR = 1e-8
"""Smallest inverse depth, 1/m."""


@trained_otherwise("30 steps a keyframe, at depths that follow from the pictures")
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class on_the_fly_nvs(KeyframeRule):
    """On-the-fly NVS: in keyframes, random pixels where the map's picture lacks detail of the
    frame.

    Each pixel with depth is seeded with the probability P(image) - P(map's picture), where

        P = 2 clamp(B |Laplacian|, 0, 1)

    so where the frame has detail that the map's picture lacks. |Laplacian| is summed over R, G, B.
    B is a blur, the mean over a disc of radius 3 pixels. P(image) and the colours of the Gaussians
    are those of the image halved and enlarged again. A round Gaussian covers the area that one
    stands for: its standard deviation is clamp(1 / sqrt(P(image)), 1, W / 10) pixels.

    Args:
        density: Multiplies both P, so the number of Gaussians, with sizes 1 / sqrt(density) times
            as large. Release: 1.
        opacity: Peak opacity. Release: 0.07 for points that it trusts, 0.02 for others, 0.2 for
            triangulated matches; measured depth counts as trusted here.
        drop_hidden: Drop points at or behind the surface that the map shows, D >= 1 / sum_k (w_k /
            z_k), as the release does. With measured depth about half of the points on a surface
            that is mapped already are dropped.

    The release has no depth camera: depth comes from multi-view stereo, and points of low
    confidence are dropped. The sum is not divided by A, so that where the map is transparent its
    surface counts as farther. Left out: coarse Gaussians that cover 10 or more new points are
    removed; pruning (opacity below 0.05, or larger than half the image). Every 5th recorded frame
    is a keyframe unless the settings say otherwise. Source: Meuleman et al. 2025 and the released
    code.
    """

    density: float = 1.0
    opacity: float = 0.07
    drop_hidden: bool = True

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The points of one keyframe."""
        soft = without_detail(ctx.frame.rgb)
        P_image = self._probability(soft)
        P = P_image
        is_hidden = torch.zeros_like(P_image, dtype=torch.bool)
        if ctx.has_map:
            view = ctx.render()
            P = P_image - self._probability(view.rgb)
            is_hidden = ctx.frame.depth_m >= 1 / blended_inverse_depth(ctx).clamp_min(FAR)
        generator = ctx.generator
        U = torch.rand(P.shape, generator=generator, device=generator.device).to(P.device)
        uv = ctx.pixels((U < P) & ~(is_hidden & self.drop_hidden))
        radius_px = (1 / ctx.values_at(P_image, uv).sqrt()).clamp(
            1.0, max(ctx.camera.width / 10, 1.0)
        )
        seeds = ctx.seeds_at(uv, radius_px, opacity=self.opacity)
        return dataclasses.replace(seeds, rgb=ctx.values_at(soft, uv).clamp(0, 1))

    def _probability(self, rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
        return 2 * self.density * disc_blur(absolute_laplacian(rgb), BLUR_PX).clamp(0, 1)


def blended_inverse_depth(ctx: SeedContext) -> Float[Tensor, "H W"]:
    """sum_k w_k / z_k of the map's Gaussians, 1/m, 0 where there is none: their picture with
    colours 1 / z. [H, W]"""
    params = ctx.gaussians.params
    T_WC = ctx.frame.T_WC
    # nearer ones are not drawn
    z = se3.apply(se3.inverse(T_WC), params.xyz_W)[:, 2].clamp_min(1e-3)
    sh = ((1 / z - 0.5) / SH_C0)[:, None, None].expand(-1, 1, 3)
    inverse = dataclasses.replace(params, sh=sh)
    return render(inverse, ctx.camera, T_WC, near_m=ctx.reading.near_plane_m).rgb[..., 0]
