"""Choosing pixels by chance, without replacement; sizes and discs of seeds; Gaussians where depth
is missing."""

import dataclasses
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..errors import ArgumentError
from ..geometry import project, se3
from ..render.constants import SHOWN_ALPHA
from ..types import Seeds
from .context import SeedContext
from .quadtree import cell_gaussians


def unmapped_pixels(
    ctx: SeedContext,
    min_alpha: float,
    median_factor: float,
    *,
    sides: Literal["in front", "both"] = "in front",
    median_of: Literal["all", "measured"] = "all",
    divided: bool = False,
) -> Bool[Tensor, "H W"]:
    """Pixels with depth that the map does not cover, or where its depth is wrong by far.

        A < min_alpha   or   ( D^ > D  and  e > median_factor * median(e) )

    with e = |D^ - D|, and 0 where D is missing. A is the accumulated opacity of the map, D^ its
    blended depth sum w_k z_k (not divided by A, as SplaTAM renders it, unless ``divided``), D the
    measured depth. Without a map: all pixels with depth.

    Args:
        ctx: Frame and map.
        min_alpha: Pixels whose A is smaller are not covered.
        median_factor: How many medians an error must exceed.
        sides: "in front": only where the measured surface lies in front of the map's (D < D^);
            "both": on both sides.
        median_of: "all": the median over all pixels, where those without depth count as 0, as in
            the released codes: if more than half of the depth is missing it is 0, and then every
            pixel with D < D^ is chosen; "measured": over the pixels with depth.
        divided: Divide D^ by A; where A is 0, so is D^.

    Source: Keetha et al. 2024 (SplaTAM), Gaussian densification; the released code.
    """
    known = ctx.has_depth()
    if not ctx.has_map:
        return known
    view = ctx.render()
    depth_m = view.depth_m / view.alpha.clamp_min(1e-6) if divided else view.depth_m
    e = depth_error_m(ctx, depth_m)
    large = e > median_factor * _median(e if median_of == "all" else e[known])
    if sides == "in front":
        large &= depth_m > ctx.frame.depth_m
    return known & ((view.alpha < min_alpha) | large)


def depth_error_m(
    ctx: SeedContext, depth_m: Float[Tensor, "H W"] | None = None
) -> Float[Tensor, "H W"]:
    """|D^ - D| of ``depth_m``, by default the map's blended depth, metres; 0 where the frame has no
    depth. [H, W]"""
    depth_m = ctx.render().depth_m if depth_m is None else depth_m
    return torch.where(
        ctx.has_depth(),
        (depth_m - ctx.frame.depth_m).abs(),
        0.0,
    )


def _median(values: Tensor) -> float:
    """The median, of an even number of values the smaller one of the middle two; infinite without
    any."""
    return float(values.median()) if values.numel() else torch.inf


def in_front(
    ctx: SeedContext, margin_m: float, where: Bool[Tensor, "H W"] | None = None
) -> Bool[Tensor, " N"]:
    """Gaussians of the map through which the frame's camera looks: their centres are nearer than
    the measured depth.

    Args:
        ctx: Frame and map.
        margin_m: By how much nearer, metres.
        where: Only centres at these pixels; by default all pixels with depth.
    """
    xyz = se3.apply(se3.inverse(ctx.frame.T_WC), ctx.map.xyz_W)
    uv = project(ctx.camera, xyz)
    z = xyz[:, 2]
    inside = (
        (z > 0)
        & (uv >= 0).all(dim=1)
        & (uv < uv.new_tensor([ctx.camera.width, ctx.camera.height])).all(dim=1)
    )
    uv = torch.where(inside[:, None], uv, 0.0)
    seen = ctx.has_depth() if where is None else ctx.has_depth() & where
    return inside & ctx.values_at(seen, uv) & (z < ctx.values_at(ctx.frame.depth_m, uv) - margin_m)


def one_pixel_seeds(
    ctx: SeedContext,
    chosen: Bool[Tensor, "H W"],
    *,
    share: float = 1.0,
    every_px: int = 1,
    opacity: float = 0.5,
) -> Seeds:
    """A round Gaussian for each chosen pixel with depth, standard deviation z / ((fx + fy) / 2):
    one pixel.

    Args:
        ctx: The frame.
        chosen: Pixels. [H, W]
        share: Share of them that is drawn at random, 0..1; sizes are 1 / sqrt(share) times as
            large, so that the Gaussians cover as much of the image.
        every_px: Only every n-th pixel of every n-th row, with n times the size.
        opacity: Peak opacity.

    Raises:
        ValueError: ``share`` not in 0..1, or ``every_px`` below 1.
    """
    if every_px < 1:
        raise ArgumentError(f"every_px must be at least 1, got {every_px}")
    if every_px > 1:
        grid = torch.zeros_like(chosen)
        grid[::every_px, ::every_px] = True
        chosen = chosen & grid
    return ctx.seeds_at(
        drawn_pixels(ctx, chosen, share), every_px * pixel_radius(ctx, share), opacity=opacity
    )


def drawn_pixels(
    ctx: SeedContext, chosen: Bool[Tensor, "H W"] | None, share: float
) -> Float[Tensor, "N 2"]:
    """Centres of the chosen pixels with depth (all without a choice), or of a random share of them,
    row by row.

    Raises:
        ValueError: ``share`` not in 0..1.
    """
    if not 0 < share <= 1:
        raise ArgumentError(f"share must be above 0 and at most 1, got {share}")
    uv = ctx.pixels(chosen)
    return uv if share == 1 else uv[ctx.draw(len(uv), round(share * len(uv)))]


def pixel_radius(ctx: SeedContext, share: float = 1.0) -> float:
    """The ``radius_px`` of ``ctx.seeds_at`` that gives z / ((fx + fy) / 2), times 1 /
    sqrt(share)."""
    # seeds_at divides by fx
    return 2 * ctx.camera.fx / (ctx.camera.fx + ctx.camera.fy) / share**0.5


MIN_SPACING_M = 1e-7**0.5
"""Smallest size, metres: Kerbl et al. 2023 limit the mean squared distance to 1e-7 from below
(released code)."""


def sized_by_neighbours(
    ctx: SeedContext,
    seeds: Seeds,
    among: Literal["new", "new and map"] = "new",
    *,
    factor: float = 1.0,
    max_of_mean: float = torch.inf,
) -> Seeds:
    """The same seeds, round, each as large as the root mean square distance to its 3 nearest
    neighbours.

    Args:
        ctx: The map.
        seeds: New Gaussians; one without any neighbour keeps its size.
        among: Whether the Gaussians of the map count as neighbours.
        factor: Multiplies the distance.
        max_of_mean: Largest standard deviation as a multiple of the mean of all.

    Source: Kerbl et al. 2023 (3DGS). The paper takes the mean of the distances, the released code
    the root of the mean of their squares.
    """
    if len(seeds) == 0:
        return seeds
    spacing = ctx.nearest(seeds.xyz_W, 3, among).spacing_m.clamp_min(MIN_SPACING_M)
    size = torch.where(
        spacing.isnan(),
        seeds.scale_m[:, 0],
        factor * spacing,
    )
    size = size.clamp(max=max_of_mean * float(size.mean()))
    return dataclasses.replace(
        seeds,
        scale_m=size[:, None].expand(-1, 3).clone(),
    )


def as_discs(
    ctx: SeedContext, seeds: Seeds, normal_W: Float[Tensor, "N 3"], thickness: float
) -> Seeds:
    """The same seeds, thin along their normals: standard deviations (s, s, thickness s), the z axis
    along the normal.

    Args:
        ctx: The frame, for its camera's position.
        seeds: Round Gaussians.
        normal_W: Normals, world frame; where one is zero, the disc faces the camera. [N, 3]
        thickness: Smallest standard deviation as a share of the others. Flat Gaussians (2DGS) have
            no third one; the renderer here needs one.
    """
    to_camera = ctx.frame.T_WC[:3, 3] - seeds.xyz_W
    axis = torch.where(
        (normal_W != 0).any(dim=1, keepdim=True),
        normal_W,
        to_camera,
    )
    return dataclasses.replace(
        seeds, quat=ctx.quat_from_normals(axis), scale_m=thin(seeds.scale_m, thickness)
    )


def pushed_back(ctx: SeedContext, seeds: Seeds, factor: float) -> Seeds:
    """The same seeds as if the depth had been ``factor`` times as large: farther from the camera,
    and larger."""
    eye = ctx.frame.T_WC[:3, 3]
    return dataclasses.replace(
        seeds, xyz_W=eye + factor * (seeds.xyz_W - eye), scale_m=factor * seeds.scale_m
    )


def thin(scale_m: Float[Tensor, "N 3"], thickness: float) -> Float[Tensor, "N 3"]:
    """Standard deviations of which the third is multiplied by ``thickness``."""
    return scale_m * scale_m.new_tensor([1.0, 1.0, thickness])


LEAST_HALF_PX = 2
"""Cells are not cut to less than this half width: at a guessed depth the finest detail is not worth
its Gaussians. On the kitchen it saves half of the added Gaussians and costs 0.2 dB of 1.5."""


def cells_without_depth(ctx: SeedContext) -> Seeds:
    """One round seed per quadtree leaf whose middle has no depth and is not shown by the map.

    The cells are not cut to the smallest. The depth is that of the measured pixels around
    (``depth_from_sides``); everything else is as in ``SeedContext.cells``. Depth nearer than
    ``ctx.near_m`` is measured, not missing: such leaves get no Gaussian. In a frame without any
    depth there are none.

    Differentiable: no. Source: ours; docs/quality.md has what it changes.
    """
    depth_m = ctx.frame.depth_m
    known = ctx.has_depth()
    if not (depth_m <= 0).any() or not known.any():
        return Seeds.empty(depth_m)
    leaves = ctx.quadtree_cells(min_cell_px=max(LEAST_HALF_PX, ctx.config.quadtree_min_cell_px))
    i, j = leaves.centre_uv.floor().long().unbind(-1)
    chosen = depth_m[j, i] <= 0
    if ctx.has_map and chosen.any():
        chosen &= ctx.render().alpha[j, i] < SHOWN_ALPHA
    if not chosen.any():
        return Seeds.empty(depth_m)
    leaves = leaves[chosen]
    i = i[chosen]
    j = j[chosen]
    filled = depth_from_sides(depth_m, known)
    placed = filled[j, i] > 0
    leaves = leaves[placed]
    i = i[placed]
    j = j[placed]
    xyz_W, scale_m = cell_gaussians(ctx.camera, leaves, filled, ctx.frame.T_WC)
    return Seeds.isotropic(
        xyz_W,
        ctx.frame.rgb[j, i],
        scale_m,
        opacity=0.5,
        tag=leaves.level,
    )


def depth_from_sides(
    depth_m: Float[Tensor, "H W"], known: Bool[Tensor, "H W"]
) -> Float[Tensor, "H W"]:
    """At each pixel the mean of the nearest known depths to the left, right, above and below,
    weighted by 1/distance^2.

    0 where there is none in its row and column.

    Args:
        depth_m: z-depth, metres. [H, W]
        known: Pixels whose depth is used. [H, W]
    """
    total = torch.zeros_like(depth_m)
    weights = torch.zeros_like(depth_m)
    for dim in (0, 1):
        for backwards in (False, True):
            d, k = (depth_m.flip(dim), known.flip(dim)) if backwards else (depth_m, known)
            place = torch.arange(d.shape[dim], device=d.device)
            place = (place[:, None] if dim == 0 else place[None]).expand(d.shape)
            last = torch.where(k, place, -1).cummax(dim).values
            near = d.gather(dim, last.clamp_min(0))
            weight = torch.where(
                last >= 0,
                1.0 / (place - last).clamp_min(1).to(d).square(),
                0.0,
            )
            near, weight = (near.flip(dim), weight.flip(dim)) if backwards else (near, weight)
            total = total + weight * near
            weights = weights + weight
    return torch.where(weights > 0, total / weights.clamp_min(1e-30), 0.0)
