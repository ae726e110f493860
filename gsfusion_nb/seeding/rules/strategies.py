"""Densification strategies of 3DGS, as gsplat does them, as rules."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...gaussians import SPLIT_SHRINKS, Edit, shared
from ...geometry import quaternion
from ...types import Seeds
from ..context import SeedContext
from ..coverage import unmapped_pixels
from ..draws import one_pixel_seeds
from ..map_rule import MapRule, StepStats
from ..points import abs_image_gradient, image_gradient, restart_statistics
from ..rule import seeding_rule, trained_otherwise
from .edge_discs import edge_discs
from .gsfusion import gsfusion, uniform

RADIUS = "largest_radius"
"""Name of the largest radius of each row in an image so far, as a share of the image's longer
side."""


@trained_otherwise("on all pictures of a scan at once")
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class default_strategy(MapRule):
    """3DGS's adaptive density control: copies small Gaussians and splits large ones where the image
    asks for detail.

    Every ``refine_every`` gradient steps, each Gaussian with a mean gradient of its centre in the
    image above ``grow_grad2d`` is copied if it is small, or split in two if it is large; nearly
    transparent and very large ones are removed. Every ``reset_every`` steps all opacities are
    lowered to at most ``2 prune_opa``.

    3DGS starts from the points of a reconstruction. Here a few pixels that the map does not cover
    are seeded in each frame, and the densification does the rest.

    Args:
        share: Share of the pixels not yet covered that is seeded, 0..1; their Gaussians are as
            large as their share.
        seeds_by: Whose seeds: "unmapped": as just said; or those of the rule "uniform",
            "edge_discs" (both as dense as ``share`` says) or "gsfusion" (as dense as the setting
            ``seeding.quadtree_threshold`` says).
        scene_scale_m: Extent of the scene, metres, the unit of the sizes in 3D. 0: 1.1 times the
            largest distance of a camera from their mean, at least 1 m (gsplat's trainer, without
            the minimum).
        prune_opa: Gaussians with a smaller opacity are removed.
        grow_grad2d: Mean length of dL/d(centre in the image) above which a Gaussian is copied or
            split; the unit in the image is half its width and half its height.
        grow_scale3d: Gaussians up to this size (largest standard deviation / scene) are copied,
            larger ones split.
        grow_scale2d: Gaussians with a larger radius in an image are split, share of the longer side
            of the image.
        prune_scale3d: Gaussians larger than this (as ``grow_scale3d``) are removed after the first
            reset.
        prune_scale2d: Gaussians with a larger radius in an image (as ``grow_scale2d``) are removed
            after it.
        refine_scale2d_stop_iter: The two sizes in the image are used until this step; 0: never.
        refine_start_iter: Step after which refining begins.
        refine_stop_iter: Step at which refining and resets end.
        refine_every: Steps between two refinings.
        reset_every: Steps between two resets of the opacity.
        pause_refine_after_reset: Steps after a reset without refining.
        revised_opacity: Halves of a split have the opacity 1 - sqrt(1 - o) (Rota Bulò et al. 2024).
        absgrad: Compare with ``grow_grad2d`` the gradient whose two components are sums of absolute
            values over the pixels, so that pixels that pull a Gaussian to opposite sides do not
            cancel. It is larger: gsplat advises ``grow_grad2d`` of about 0.0008 with it.

    The names and defaults are gsplat's, and so are the rows that change, with two exceptions. The
    resets really happen; in gsplat 1.5.3 they never do, because
    ``step % reset_every == 0 & step > 0`` is always false in Python. A Gaussian that is small but
    large in an image is only split; gsplat copies it as well. In RTG-SLAM, which does not optimise
    opacities, set ``reset_every`` above the number of steps. Source: Kerbl et al. 2023, section 5;
    Ye et al. 2024 (AbsGS); gsplat 1.5.3, ``strategy/default.py``.
    """

    share: float = 0.05
    seeds_by: Literal["unmapped", "uniform", "gsfusion", "edge_discs"] = "unmapped"
    scene_scale_m: float = 0.0
    prune_opa: float = 0.005
    grow_grad2d: float = 0.0002
    grow_scale3d: float = 0.01
    grow_scale2d: float = 0.05
    prune_scale3d: float = 0.1
    prune_scale2d: float = 0.15
    refine_scale2d_stop_iter: int = 0
    refine_start_iter: int = 500
    refine_stop_iter: int = 15_000
    refine_every: int = 100
    reset_every: int = 3000
    pause_refine_after_reset: int = 0
    revised_opacity: bool = False
    absgrad: bool = False

    needs: ClassVar[frozenset[str]] = frozenset({"image_gradients"})

    def statistics(self) -> frozenset[str]:
        """The gradients with signs or, with ``absgrad``, without."""
        return frozenset({"abs_image_gradients"}) if self.absgrad else self.needs

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """A share of the pixels that the map does not cover, or the seeds of another rule."""
        return strategy_seeds(ctx, self.seeds_by, self.share)

    def after_step(
        self,
        ctx: SeedContext,
        stats: StepStats,
        memory: dict[str, Any],
    ) -> Edit | None:
        """Refine or reset, where it is time."""
        step = stats.step - 1  # gsplat counts from 0
        last = memory.get("step", -1)
        memory["step"] = step
        if step >= self.refine_stop_iter:
            return None
        if self.refine_scale2d_stop_iter > 0:
            side = max(stats.camera.width, stats.camera.height)
            radius = ctx.gaussians.row_memory(RADIUS)
            assert stats.radius_px is not None
            torch.maximum(radius, stats.radius_px / side, out=radius)
        refines = (
            step // self.refine_every > last // self.refine_every and step > self.refine_start_iter
        )
        resets = step // self.reset_every > last // self.reset_every and step > 0
        edit: dict[str, Any] = {}
        if refines and step % self.reset_every >= self.pause_refine_after_reset:
            edit = self._refinement(ctx, step)
            restart_statistics(ctx.gaussians)
            if RADIUS in ctx.gaussians.memory:
                ctx.gaussians.memory[RADIUS].zero_()
        if resets:
            edit["reset_opacity"] = 2 * self.prune_opa
        return Edit(**edit) if edit else None

    def _refinement(self, ctx: SeedContext, step: int) -> dict[str, Tensor | bool]:
        """Which rows are copied, split and removed."""
        gradient = (abs_image_gradient if self.absgrad else image_gradient)(ctx.gaussians)
        size = ctx.map.scale_m.amax(dim=1)
        scene = self._scene_m(ctx)
        assert gradient is not None
        grows = gradient > self.grow_grad2d
        small = size <= self.grow_scale3d * scene
        clone = grows & small
        to_split = grows & ~small
        if step < self.refine_scale2d_stop_iter:
            to_split = to_split | (ctx.gaussians.row_memory(RADIUS) > self.grow_scale2d)
            clone = clone & ~to_split
        to_prune = self._rows_to_prune(ctx, to_split, size / scene, step)
        return {
            "clone": clone & ~to_prune,
            "split": to_split & ~to_prune,
            "keep": ~to_prune,
            "split_shares": self.revised_opacity,
        }

    def _rows_to_prune(
        self,
        ctx: SeedContext,
        to_split: Bool[Tensor, " N"],
        size: Float[Tensor, " N"],
        step: int,
    ) -> Bool[Tensor, " N"]:
        """Rows to remove, themselves or, of those that are split, their halves."""
        opacity = ctx.map.opacity
        if self.revised_opacity:
            opacity = torch.where(to_split, 1 - (1 - opacity).sqrt(), opacity)
        to_prune = opacity < self.prune_opa
        if step > self.reset_every:
            to_prune = to_prune | (
                torch.where(to_split, size / SPLIT_SHRINKS, size) > self.prune_scale3d
            )
            if step < self.refine_scale2d_stop_iter:
                to_prune = to_prune | (ctx.gaussians.row_memory(RADIUS) > self.prune_scale2d)
        return to_prune

    def _scene_m(self, ctx: SeedContext) -> float:
        if self.scene_scale_m > 0:
            return self.scene_scale_m
        places = torch.stack([T[:3, 3] for T in (*ctx.past_T_WC, ctx.frame.T_WC_cpu)])
        return max(
            1.0,
            1.1 * float((places - places.mean(dim=0)).norm(dim=1).max()),
        )


def strategy_seeds(ctx: SeedContext, seeds_by: str, share: float) -> Seeds:
    """The seeds from which a strategy starts: ``seeds_by`` and ``share`` as for
    ``default_strategy``."""
    if seeds_by == "uniform":
        return uniform(ctx, fraction=share)
    if seeds_by == "gsfusion":
        return gsfusion(ctx)
    # a hexagonal grid of spacing s has 1 / (s^2 sqrt(3) / 2) points per pixel
    if seeds_by == "edge_discs":
        return edge_discs(ctx, spacing_px=max((share * 3**0.5 / 2) ** -0.5, 1.0))
    return one_pixel_seeds(ctx, unmapped_pixels(ctx, 0.5, torch.inf), share=share)


@trained_otherwise("on all pictures of a scan at once")
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class mcmc(MapRule):
    """3DGS-MCMC: Gaussians that have become transparent move to others, and all move a little at
    random.

    Every ``refine_every`` gradient steps each Gaussian with an opacity up to ``min_opacity``
    becomes a copy of another, drawn with a probability proportional to its opacity, and 5 % more
    Gaussians are added in the same way, up to ``cap_max``. The copies of a Gaussian together look
    as it did. After every step a random motion, in the shape of the Gaussian and largest for
    transparent ones, is added to each centre.

    3DGS-MCMC starts from the points of a reconstruction. Here a few pixels that the map does not
    cover are seeded in each frame, until there are ``cap_max`` Gaussians.

    Args:
        share: Share of the pixels not yet covered that is seeded, 0..1; their Gaussians are as
            large as their share.
        seeds_by: Whose seeds, as for ``default_strategy``.
        cap_max: Largest number of Gaussians.
        noise_lr: Size of the random motion, in learning rates.
        lr_xyz: Learning rate of the centres, to which the random motion is proportional; that of
            the settings.
        refine_start_iter: Step after which Gaussians are moved and added.
        refine_stop_iter: Step at which that ends.
        refine_every: Steps between two times.
        min_opacity: Gaussians up to this opacity are moved.

    The names and defaults are gsplat's, and so are the rows that change. In a step in which
    Gaussians are moved or added, the random motion comes before that, in gsplat after it. The
    penalties of large opacities and scales are those of the publication. It needs a map whose
    opacities are optimised, such as GSFusion's. Source: Kheradmand et al. 2024, section 4; gsplat
    1.5.3, ``strategy/mcmc.py``.
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

    overrides: ClassVar[Mapping[str, Any]] = {
        "optim__opacity_weight": 0.01,
        "optim__scale_weight": 0.01,
    }

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """A share of the pixels that the map does not cover, as far as there is room."""
        seeds = strategy_seeds(ctx, self.seeds_by, self.share)
        return (
            seeds[: max(0, self.cap_max - len(ctx.map))] if ctx.has_map else seeds[: self.cap_max]
        )

    def after_step(
        self,
        ctx: SeedContext,
        stats: StepStats,
        memory: dict[str, Any],
    ) -> Edit | None:
        """A random motion of all; and move and add some, where it is time."""
        step = stats.step - 1  # gsplat counts from 0
        last = memory.get("step", -1)
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
        n = torch.randn(
            len(where),
            3,
            generator=ctx.generator,
            device=ctx.generator.device,
        ).to(where.xyz_W)
        size = torch.sigmoid(100 * (1 - where.opacity - 0.995)) * self.lr_xyz * self.noise_lr
        M = quaternion.to_matrix(where.quat) * where.scale_m[:, None]
        return (M @ M.mT @ (n * size[:, None])[:, :, None]).squeeze(2)

    def _moved_and_added(self, ctx: SeedContext) -> dict[str, Any]:
        opacity = ctx.map.opacity.clone()
        dead = opacity <= self.min_opacity
        dead_row = dead.nonzero()[:, 0]
        alive = (~dead).nonzero()[:, 0]
        edit: dict[str, Any] = {}
        if len(dead_row) and len(alive):
            target = alive[self._draw_rows(ctx, opacity[alive], len(dead_row))]
            source, times = target.unique(return_counts=True)
            opacity[source] = shared(
                opacity[source], ctx.map.scale_m[source], times + 1, self.min_opacity
            )[0]
            opacity[dead_row] = opacity[target]
            edit["relocate"] = (dead_row, target)
        more = min(self.cap_max, int(1.05 * len(opacity))) - len(opacity)
        if more > 0:
            edit |= {"clone": self._draw_rows(ctx, opacity, more), "clone_shares": True}
        return edit

    def _draw_rows(
        self,
        ctx: SeedContext,
        weights: Float[Tensor, " N"],
        n: int,
    ) -> Int[Tensor, " n"]:
        """``n`` rows, drawn with these weights; a row may be drawn several times."""
        at = ctx.generator.device
        return torch.multinomial(
            weights.to(at),
            n,
            replacement=True,
            generator=ctx.generator,
        ).to(weights.device)
