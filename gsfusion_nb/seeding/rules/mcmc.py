"""3DGS as Markov chain Monte Carlo, as gsplat's MCMCStrategy does it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...gaussians import Edit, shared
from ...geometry import quaternion
from ...types import Seeds
from ..context import SeedContext
from ..rule import MapRule, StepStats, seeding_rule
from .default_strategy import strategy_seeds


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class mcmc(MapRule):
    """3DGS-MCMC: Gaussians that have become transparent move to others, and all move a little at random.

    Every ``refine_every`` gradient steps each Gaussian with an opacity up to ``min_opacity`` becomes a copy of another,
    drawn with a probability proportional to its opacity, and 5 % more Gaussians are added in the same way, up to
    ``cap_max``. The copies of a Gaussian together look as it did. After every step a random motion, in the shape of the
    Gaussian and largest for transparent ones, is added to each centre.

    3DGS-MCMC starts from the points of a reconstruction. Here a few pixels that the map does not cover are seeded in
    each frame, until there are ``cap_max`` Gaussians.

    Args:
        share: Share of the pixels not yet covered that is seeded, 0..1; their Gaussians are as large as their share.
        seeds_by: Whose seeds, as for ``default_strategy``.
        cap_max: Largest number of Gaussians.
        noise_lr: Size of the random motion, in learning rates.
        lr_xyz: Learning rate of the centres, to which the random motion is proportional; that of the settings.
        refine_start_iter: Step after which Gaussians are moved and added.
        refine_stop_iter: Step at which that ends.
        refine_every: Steps between two times.
        min_opacity: Gaussians up to this opacity are moved.

    The names and defaults are gsplat's, and so are the rows that change. In a step in which Gaussians are moved or
    added, the random motion comes before that, in gsplat after it. The penalties of large opacities and scales are
    those of the publication. It needs a map whose opacities are optimised, such as GSFusion's.
    Source: Kheradmand et al. 2024, section 4; gsplat 1.5.3, ``strategy/mcmc.py``.
    """

    share: float = 0.05
    seeds_by: Literal["unmapped", "uniform", "gsfusion", "edge_discs"] = "unmapped"
    cap_max: int = 1_000_000
    noise_lr: float = 5e5
    lr_xyz: float = 1.6e-4
    refine_start_iter: int = 500
    refine_stop_iter: int = 25_000
    refine_every: int = 100
    min_opacity: float = 0.005

    overrides: ClassVar[Mapping[str, Any]] = {"optim__opacity_weight": 0.01, "optim__scale_weight": 0.01}

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """A share of the pixels that the map does not cover, as far as there is room."""
        seeds = strategy_seeds(ctx, self.seeds_by, self.share)
        return seeds[: max(0, self.cap_max - len(ctx.map))] if ctx.has_map else seeds[: self.cap_max]

    def after_step(self, ctx: SeedContext, stats: StepStats, memory: dict[str, Any]) -> Edit | None:
        """A random motion of all; and move and add some, where it is time."""
        step, last = stats.step - 1, memory.get("step", -1)  # gsplat counts from 0
        memory["step"] = step
        if not len(ctx.map):
            return None
        edit: dict[str, Any] = {"min_opacity": self.min_opacity}
        if self.noise_lr > 0:
            every = torch.arange(len(ctx.map), device=ctx.map.xyz_W.device)
            edit["set"] = {"xyz_W": (every, ctx.map.xyz_W + self._motion(ctx))}
        refines = step // self.refine_every > last // self.refine_every
        if refines and self.refine_start_iter < step < self.refine_stop_iter:
            edit |= self._moved_and_added(ctx)
        return Edit(**edit) if len(edit) > 1 else None

    def _motion(self, ctx: SeedContext) -> Float[Tensor, "N 3"]:
        """Sigma n lr sigmoid(100 ((1 - o) - 0.995)),  n standard normal."""
        where = ctx.map
        n = torch.randn(len(where), 3, generator=ctx.generator, device=ctx.generator.device).to(where.xyz_W)
        size = torch.sigmoid(100 * (1 - where.opacity - 0.995)) * self.lr_xyz * self.noise_lr
        M = quaternion.to_matrix(where.quat) * where.scale_m[:, None]
        return (M @ M.mT @ (n * size[:, None])[:, :, None]).squeeze(2)

    def _moved_and_added(self, ctx: SeedContext) -> dict[str, Any]:
        opacity = ctx.map.opacity.clone()
        dead = opacity <= self.min_opacity
        moved, alive = dead.nonzero()[:, 0], (~dead).nonzero()[:, 0]
        edit: dict[str, Any] = {}
        if len(moved) and len(alive):
            target = alive[self._drawn(ctx, opacity[alive], len(moved))]
            once, times = target.unique(return_counts=True)
            opacity[once] = shared(opacity[once], ctx.map.scale_m[once], times + 1, self.min_opacity)[0]
            opacity[moved] = opacity[target]
            edit["relocate"] = (moved, target)
        more = min(self.cap_max, int(1.05 * len(opacity))) - len(opacity)
        if more > 0:
            edit |= {"clone": self._drawn(ctx, opacity, more), "clone_shares": True}
        return edit

    def _drawn(self, ctx: SeedContext, weights: Float[Tensor, " N"], n: int) -> Int[Tensor, " n"]:
        """``n`` rows, drawn with these weights; a row may be drawn several times."""
        at = ctx.generator.device
        return torch.multinomial(weights.to(at), n, replacement=True, generator=ctx.generator).to(weights.device)
