"""GaME's rule: keyframes add what is new or looks wrong, and remove what the camera now sees through."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from ...gaussians import Edit
from ...types import Seeds
from ..context import SeedContext
from ..rule import KEYFRAMES, MapRule, StepStats, When, seeding_rule
from ..sampling import in_front, sized_by_neighbours, unmapped_pixels


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class game(MapRule):
    """GaME: in keyframes, Gaussians where the map is empty, behind or of another colour; stale ones are removed.

    Half of the pixels with depth where

        A < 0.3   or   ( D^ > D  and  |D^ - D| > 40 median |D^ - D| )   or   mean over R, G, B of |C^ - C| > 0.1

    with the map's picture C^ over white. Round Gaussians of standard deviation sqrt(0.05) d, with the root mean square
    distance d to the 3 nearest neighbours, new or in the map. After the last gradient step of a frame the Gaussians are
    removed that lie in front of the measured depth by more than 5 cm at a pixel whose colour is wrong by more than 0.1
    (the scene has changed there), and after half of the steps and the last one those with an opacity below 0.1.

    Args:
        min_alpha: Pixels with a smaller accumulated opacity A are seeded. Release: 0.3.
        median_factor: How many medians a depth error must exceed. Release: 40.
        colour_error: Mean absolute colour error (0..1) above which a pixel is seeded, and a Gaussian may be stale.
            Release: 0.1.
        stale_m: How far in front of the measured depth a stale Gaussian lies, metres. Release: 0.05.
        min_opacity: Gaussians with a lower opacity are removed. Release: 0.1.
        share: Share of the pixels that is drawn at random, 0..1; the sizes follow from the distances. The release takes
            every second one: 0.5.

    Left out: masks of objects from a segmentation network, by which the release also removes the rest of an object, and
    ignores stale parts of keyframes. Every 5th recorded frame is a keyframe unless the settings say otherwise; the
    release's numbers were read in a port of its code to the CPU.
    Source: Yugay et al. 2026 (GaME, arXiv 2506.06909) and its released code.
    """

    min_alpha: float = 0.3
    median_factor: float = 40.0
    colour_error: float = 0.1
    stale_m: float = 0.05
    min_opacity: float = 0.1
    share: float = 0.5

    when: ClassVar[When] = KEYFRAMES
    overrides: ClassVar[Mapping[str, Any]] = {"keyframe_every": 5}

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The Gaussians of one keyframe."""
        chosen = unmapped_pixels(ctx, self.min_alpha, self.median_factor)
        if ctx.has_map:
            view = ctx.render()
            over_white = view.rgb + (1 - view.alpha)[..., None]
            chosen |= (over_white - ctx.frame.rgb).abs().mean(dim=-1) > self.colour_error
        uv = ctx.pixels(chosen)
        uv = uv[ctx.draw(len(uv), round(self.share * len(uv)))]
        return sized_by_neighbours(ctx, ctx.seeds_at(uv, 1.0), "new and map", factor=0.05**0.5)

    def after_step(self, ctx: SeedContext, stats: StepStats, memory: dict[str, Any]) -> Edit | None:
        """Remove transparent Gaussians and, after the last step, stale ones."""
        step, last = stats.step_in_frame, stats.steps_in_frame
        if stats.stage != "online" or step not in (last // 2 + 1, last):
            return None
        keep = ctx.map.opacity >= self.min_opacity
        if step == last and len(ctx.map):
            wrong = (ctx.render().rgb - ctx.frame.rgb).abs().mean(dim=-1) > self.colour_error
            keep &= ~in_front(ctx, self.stale_m, wrong)
        return None if keep.all() else Edit(keep=keep)
