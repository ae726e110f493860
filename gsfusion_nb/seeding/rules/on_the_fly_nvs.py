"""The rule of on-the-fly novel view synthesis: random pixels where the map's picture lacks detail."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from ...types import Seeds
from ..context import SeedContext
from ..image_features import absolute_laplacian, disc_blur
from ..map_rule import KEYFRAMES, MapRule, When
from ..rule import seeding_rule

MIN_ALPHA = 0.5


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class on_the_fly_nvs(MapRule):
    """On-the-fly NVS: in keyframes, random pixels where the map's picture lacks detail of the frame.

    Each pixel with depth is seeded with the probability P(image) - P(map's picture), where

        P = 2 clamp(B |Laplacian|, 0, 1),      |Laplacian| summed over R, G, B,   B a blur with a disc

    so where the frame has detail that the map's picture lacks. A round Gaussian covers the area that one stands for:
    its standard deviation is clamp(1 / sqrt(P(image)), 1, W / 10) pixels.

    Args:
        density: Multiplies both P, so the number of Gaussians, with sizes 1 / sqrt(density) times as large. Release: 1.
        blur_px: Radius of the disc, pixels. The release's was not available; 3 is chosen here.
        opacity: Peak opacity. Release: 0.07 for points that it trusts, 0.02 for others, 0.2 for triangulated matches;
            measured depth counts as trusted here.
        drop_hidden: Drop points at or behind the surface that the map shows (D >= D^), as the release does. With
            measured depth about half of the points on a surface that is mapped already are dropped.

    The release has no depth camera: depth comes from multi-view stereo, and points of low confidence are dropped. D^ is
    the map's blended depth divided by its accumulated opacity A, where A is at least 0.5. Left out: coarse Gaussians
    that cover 10 or more new points are removed; pruning (opacity below 0.05, or larger than half the image). Every 5th
    mapped frame is a keyframe unless the settings say otherwise.
    Source: Meuleman et al. 2025 and the released code.
    """

    density: float = 1.0
    blur_px: float = 3.0
    opacity: float = 0.07
    drop_hidden: bool = True

    when: ClassVar[When] = KEYFRAMES
    overrides: ClassVar[Mapping[str, Any]] = {"keyframe_every": 5}

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The points of one keyframe."""
        P_image = 2 * self.density * disc_blur(ctx.laplacian(), self.blur_px).clamp(0, 1)
        P, hidden = P_image, torch.zeros_like(P_image, dtype=torch.bool)
        if ctx.has_map:
            view = ctx.render()
            P = P_image - 2 * self.density * disc_blur(absolute_laplacian(view.rgb), self.blur_px).clamp(0, 1)
            covered = view.alpha >= MIN_ALPHA
            hidden = covered & (ctx.frame.depth_m >= view.depth_m / view.alpha.clamp_min(MIN_ALPHA))
        generator = ctx.generator
        U = torch.rand(P.shape, generator=generator, device=generator.device).to(P.device)
        uv = ctx.pixels((U < P) & ~(hidden & self.drop_hidden))
        radius_px = (1 / ctx.values_at(P_image, uv).sqrt()).clamp(1.0, max(ctx.camera.width / 10, 1.0))
        return ctx.seeds_at(uv, radius_px, opacity=self.opacity)
