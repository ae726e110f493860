"""SplaTAM's mapping as a rule: its seeding, its losses and learning rates, and its pruning."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from ...gaussians import Edit
from ...geometry.spherical_harmonics import SH_C0
from ...types import Seeds
from ..context import SeedContext
from ..rule import EVERY_FRAME, MapRule, StepStats, When, seeding_rule
from .splatam import splatam

RADIUS = "scene_radius_m"
PRUNED_AFTER = (1, 21)
"""Steps of a frame after which Gaussians are removed: iterations 0 and 20, counted from 0."""


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class splatam_like(MapRule):
    """SplaTAM-like mapping in GSFusion's frame step: seeding, losses, learning rates, number of steps, pruning.

    Seeds as the rule ``splatam``. Loss: depth L1 + 0.5 (0.8 L1 + 0.2 (1 - SSIM)), here twice that. Adam's rates:
    centres 1e-4, colours 0.0025, opacity logits 0.05, log-scales 0.001, rotations 0.001. 60 steps a frame. After the
    1st and the 21st step of a frame, Gaussians with an opacity below 0.005 or a standard deviation above 0.1 of the
    scene's radius are removed. The radius is a third of the largest depth of the first frame.

    Args:
        min_alpha: As for ``splatam``.
        median_factor: As for ``splatam``.
        share: As for ``splatam``.
        min_opacity: Gaussians with a lower opacity are removed. Release: 0.005.
        max_extent: Largest standard deviation as a share of the scene's radius. Release: 0.1. With a ``share`` below 1,
            1 / sqrt(share) times that, as the sizes of the seeds.
        radius_share: The scene's radius as a share of the largest depth of the first frame. Release: 1/3 (TUM: 1/2).

    The release takes 30 steps a frame on TUM. It draws the views of its steps from frames that overlap; here, on a
    keyframe (every 5th frame) all 60 steps are on the frame, on others 30 are, and up to 30 on earlier keyframes drawn
    at random. Colours are SH coefficients of degree 0, and their rate is divided by the factor between the two. There
    are no steps after the scan. Left out: tracking.
    Source: Keetha et al. 2024 (SplaTAM) and its released code.
    """

    min_alpha: float = 0.5
    median_factor: float = 50.0
    share: float = 1.0
    min_opacity: float = 0.005
    max_extent: float = 0.1
    radius_share: float = 1 / 3

    when: ClassVar[When] = EVERY_FRAME
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
        return splatam(ctx, min_alpha=self.min_alpha, median_factor=self.median_factor, share=self.share)

    def after_step(self, ctx: SeedContext, stats: StepStats, memory: dict[str, Any]) -> Edit | None:
        """Remove transparent and large Gaussians."""
        if stats.stage != "online" or stats.step_in_frame not in PRUNED_AFTER:
            return None
        large = ctx.map.scale_m.amax(dim=1) > self.max_extent * memory[RADIUS] / self.share**0.5
        keep = (ctx.map.opacity >= self.min_opacity) & ~large
        return None if keep.all() else Edit(keep=keep)
