"""MonoGS's mapping as a rule: its seeding, the isotropy loss, and 3DGS's densification with its thresholds."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch

from ...gaussians import Edit
from ...types import Seeds
from ..context import SeedContext
from ..points import restart_statistics
from ..rule import KEYFRAMES, MapRule, StepStats, When, seeding_rule
from .monogs import monogs

LARGEST = "largest_radius_px"
"""For each row: its largest radius in a picture since the last densification."""
SMALL_SHARE, LARGE_SHARE = 0.01, 0.1
"""3DGS: Gaussians below the first share of the extent are cloned and not split; above the second they are removed."""
RESET_OPACITY = 0.4


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class monogs_like(MapRule):
    """MonoGS-like mapping in GSFusion's frame step: seeding in keyframes, isotropy loss, 3DGS's densification.

    Seeds as the rule ``monogs``. Every 150 steps, Gaussians whose centre has a mean gradient in the image of at least
    2e-4 are cloned if they are smaller than 0.01 of the extent (1 m), else split; and Gaussians with an opacity below
    0.7, larger than 0.1 of the extent, or with a radius above 20 pixels in a picture since the last time are removed.
    Every 2001 steps, Gaussians that are not visible get the opacity 0.4.

    Args:
        preset: As for ``monogs``.
        density: As for ``monogs``.
        densify_every: Number of steps between densifications. Release: 150.
        min_gradient: Mean gradient from which on Gaussians are densified, in units of half the image. Release: 2e-4.
        min_opacity: Gaussians with a lower opacity are removed. Release: 0.7.
        extent_m: Extent of the scene, metres. Release: 1.
        max_radius_px: Largest radius in a picture, pixels. Release: 20.
        reset_every: Number of steps between resets of the opacity; 0: never. Release: 2001.

    The weight of the isotropy loss is 10. Here every 5th recorded frame is a keyframe, with 30 steps on each frame (on
    others than keyframes 20, and up to 10 on earlier keyframes), so that 150 steps fall on a keyframe; these numbers
    are chosen here. "Not visible" is judged by the view of that step; a radius reaches to where alpha is 1/255. Left
    out: the window of covisible keyframes, its loss on depth (0.05, beside 0.95 of the colour), pruning by
    covisibility, which takes effect only without depth, and 26,000 steps of colour refinement after the scan.
    Source: Matsuki et al. 2024 (MonoGS) and its released code; Kerbl et al. 2023 (3DGS), section 5.2.
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

    def after_step(self, ctx: SeedContext, stats: StepStats, memory: dict[str, Any]) -> Edit | None:
        """Densify, prune and reset when it is time to."""
        assert stats.visible is not None
        assert stats.radius_px is not None
        largest = ctx.gaussians.row_memory(LARGEST)
        torch.maximum(largest, stats.radius_px, out=largest)
        if stats.stage != "online":
            return None
        densify = stats.step % self.densify_every == 0
        reset = self.reset_every > 0 and stats.step % self.reset_every == 0
        hidden = ~stats.visible
        settings = {"opacity": (hidden, torch.full_like(ctx.map.opacity[hidden], RESET_OPACITY))} if reset else {}
        if not densify:
            return Edit(set=settings) if settings else None
        edit = self._densified(ctx, largest > self.max_radius_px, settings)
        largest.zero_()
        restart_statistics(ctx.gaussians)
        return edit

    def _densified(self, ctx: SeedContext, wide: torch.Tensor, settings: dict[str, Any]) -> Edit:
        """Clone, split and remove as 3DGS does, where copies of what is removed would be removed as well."""
        size = ctx.map.scale_m.amax(dim=1)
        keep = (ctx.map.opacity >= self.min_opacity) & (size <= LARGE_SHARE * self.extent_m) & ~wide
        assert ctx.map.image_gradient is not None
        grows = keep & (ctx.map.image_gradient >= self.min_gradient)
        small = size <= SMALL_SHARE * self.extent_m
        return Edit(set=settings, clone=grows & small, split=grows & ~small, keep=keep)
