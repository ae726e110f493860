"""RTG-SLAM's rule: opaque discs where the surface is new or wrong, transparent ones where only the
colour is wrong."""

import dataclasses
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...backends import piece
from ...errors import ArgumentError
from ...gaussians import STABLE, UNSTABLE
from ...geometry import pixel_grid, quaternion
from ...render import SurfaceView
from ...types import Seeds
from ..context import SeedContext
from ..draws import draw_rows
from ..map_queries import disc_view
from ..points import k_nearest, nearest_others
from ..rule import seeding_rule, trained_otherwise

NEW_AREA = 1
DEPTH_ERROR = 2
COLOUR_ERROR = 3
"""Tags: why a Gaussian was added."""

OPAQUE_OPACITY = 0.99
TRANSPARENT_OPACITY = 0.1
ERROR_SHARE = 0.05
"""Released code: share of the pixels with errors that is drawn, independent of the share of new
pixels."""
UNSTABLE_REACH = 0.6
"""Released code: nothing is added within this many radii of an unstable Gaussian."""
NEIGHBOURS = 3
"""Number of nearest neighbours that are considered (released code)."""
REACH = 3.0
"""An existing disc covers the space within this many of its radii (released code)."""
BORDER_M = 0.05
"""Existing discs farther than this outside the new points' bounding box are ignored, metres."""


@trained_otherwise("opacities fixed, only unstable Gaussians are optimised")
@seeding_rule
def rtg_slam(
    ctx: SeedContext,
    *,
    share: float = 0.05,
    min_transmittance: float = 0.5,
    depth_error_m: float = 0.1,
    colour_error: float = 0.1,
    transparent: bool = True,
    transparent_radius_m: float = 0.01,
    min_radius_m: float = 0.001,
    max_radius_m: float = 0.05,
    thickness: float = 0.1,
    fidelity: Literal["measured", "paper", "code"] = "measured",
) -> Seeds:
    """Discs for three kinds of pixels with depth: newly seen, wrong in depth, wrong in colour only
    (Eq. 6).

        M_s = { T > delta_T  or  |D^ - D| > delta_d },   M_c = { |C^ - C| > delta_c } \\ M_s

    A share of each is drawn at random. Those of M_s become opaque discs. For one of M_c the disc
    that its ray hits decides: if it is unstable, nothing is added; if it is stable, a transparent
    disc is added to correct the colour. Discs lie in the measured surface and are as wide as the
    gap to their neighbours.

    Args:
        ctx: Frame and Gaussian map; without a map every pixel is new.
        share: Share of the pixels of each kind that is drawn, 0..1; with "code" only of newly seen
            pixels, and 0.05 of the others. Larger: more Gaussians, denser map.
        min_transmittance: delta_T: a pixel is newly seen if more than this share of its light
            passes the map.
        depth_error_m: delta_d: larger depth errors count as wrong, metres.
        colour_error: delta_c: larger mean absolute differences over R, G, B (0..1) count as wrong.
        transparent: False adds no transparent discs (the ablation of Fig. 6).
        transparent_radius_m: Largest radius of a transparent disc, metres (paper; the code has no
            such limit).
        min_radius_m: Smallest radius of any disc, metres.
        max_radius_m: Largest radius of any disc, metres.
        thickness: Smallest standard deviation, as a share of the radius.
        fidelity: "paper": as above; a pixel that hits no disc is wrong in depth. "code": pixels of
            the two error kinds are one kind; nothing is added near an unstable disc, nor within 3
            radii of any disc; a new disc on a stable disc's plane is transparent, whatever its
            kind. "measured": as the paper, but a pixel without a hit has no depth error, no opaque
            disc is added within 3 radii of an existing opaque one, and no transparent disc within 3
            radii of a transparent one, if the map has states.

    Source: Peng et al. 2024, section 3.2, "Gaussians adding"; sizes and "code" from the released
    code.
    """
    if not 0 < share <= 1:
        raise ArgumentError(f"rtg_slam: share must be above 0 and at most 1, got {share}")
    usable = ctx.has_depth() & (ctx.normals() != 0).any(dim=-1)
    kinds = {NEW_AREA: usable}
    view = None
    if ctx.gaussians is not None and len(ctx.map):
        view = disc_view(ctx)
        kinds = wrong_pixels(
            ctx, view, usable, min_transmittance, depth_error_m, colour_error, fidelity
        )
    shares = {NEW_AREA: share} | dict.fromkeys(
        (DEPTH_ERROR, COLOUR_ERROR), ERROR_SHARE if fidelity == "code" else share
    )
    pixels = {kind: draw_share(ctx, mask, shares[kind]) for kind, mask in kinds.items()}
    pixel = torch.cat(list(pixels.values()))
    tag = torch.cat([torch.full_like(p, kind) for kind, p in pixels.items()])
    seeds = discs_at(ctx, pixel, tag)
    if view is not None:
        decide = _decide_by_plane if fidelity == "code" else _decide_by_hit
        opacity = decide(ctx, view, seeds, pixel, depth_error_m)
        if not transparent:
            opacity = torch.where(opacity == TRANSPARENT_OPACITY, 0.0, opacity)
        seeds = dataclasses.replace(seeds, opacity=opacity)[opacity > 0]
    limit = max_radius_m if fidelity == "code" else transparent_radius_m
    return with_radii(ctx, seeds, min_radius_m, max_radius_m, limit, thickness, fidelity)


def wrong_pixels(
    ctx: SeedContext,
    view: SurfaceView,
    usable: Bool[Tensor, "H W"],
    min_transmittance: float,
    depth_error_m: float,
    colour_error: float,
    fidelity: str,
) -> dict[int, Bool[Tensor, "H W"]]:
    """Pixels by kind, no pixel in two (Eq. 6).

    A pixel that hits no disc has no rendered depth and so is wrong in depth in the paper; otherwise
    it has no depth error, as in the released code.
    """
    depth_m = ctx.frame.depth_m
    seen_m = (
        view.depth_m
        if fidelity == "paper"
        else torch.where(view.depth_m > 0, view.depth_m, depth_m)
    )
    limits = (min_transmittance, depth_error_m, colour_error)
    surface, colour = adding_masks(
        view.transmittance, seen_m, depth_m, view.rgb, ctx.frame.rgb, *limits
    )
    surface = usable & surface
    colour = usable & colour
    unseen = view.transmittance > min_transmittance
    new = surface & unseen
    depth = surface & ~unseen
    if fidelity == "code":
        return {NEW_AREA: new, DEPTH_ERROR: depth | colour}
    return {NEW_AREA: new, DEPTH_ERROR: depth, COLOUR_ERROR: colour}


@piece
def adding_masks(
    transmittance: Float[Tensor, "H W"],
    seen_m: Float[Tensor, "H W"],
    depth_m: Float[Tensor, "H W"],
    seen_rgb: Float[Tensor, "H W 3"],
    rgb: Float[Tensor, "H W 3"],
    min_transmittance: float,
    depth_error_m: float,
    colour_error: float,
) -> tuple[Bool[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """The masks M_s, where the surface is new or wrong, and M_c, where only the colour is wrong
    (Eq. 6).

    Args:
        transmittance, seen_m, seen_rgb: What the camera sees of the map: T^, depth D^ in metres,
            colour C^.
        depth_m, rgb: Measured depth D, metres, 0 where missing, and colour C.
        min_transmittance, depth_error_m, colour_error: delta_T, delta_d, delta_c, all to be
            exceeded.

    Source: Peng et al. 2024, Eq. 6.
    """
    has_depth = depth_m > 0
    unseen = transmittance > min_transmittance
    wrong_depth = (seen_m - depth_m).abs() > depth_error_m
    surface = has_depth & (unseen | wrong_depth)  # RTG-SLAM Eq. 6
    colour = has_depth & ~surface & ((seen_rgb - rgb).abs().mean(dim=-1) > colour_error)
    return surface, colour


def draw_share(
    ctx: SeedContext,
    mask: Bool[Tensor, "H W"],
    share: float,
) -> Int[Tensor, " M"]:
    """Indices into the flat image of a random share of the pixels, without replacement, in image
    order."""
    pixel = mask.flatten().nonzero().squeeze(1)
    return pixel[draw_rows(ctx, len(pixel), round(share * len(pixel)))]


def discs_at(
    ctx: SeedContext,
    pixel: Int[Tensor, " M"],
    tag: Int[Tensor, " M"],
) -> Seeds:
    """Opaque discs on the measured surface, their thin axis z along the normal, with sizes still to
    be set."""
    uv = pixel_grid(ctx.camera, device=pixel.device).view(-1, 2)[pixel]
    normal_W = ctx.normals_W().reshape(-1, 3)[pixel]
    z = torch.zeros_like(normal_W)
    z[:, 2] = 1.0
    seeds = ctx.seeds_at(uv, 1.0, opacity=OPAQUE_OPACITY, tag=tag)
    return dataclasses.replace(seeds, quat=quaternion.shortest_arc(z, normal_W))


def with_radii(
    ctx: SeedContext,
    seeds: Seeds,
    min_radius_m: float,
    max_radius_m: float,
    transparent_radius_m: float,
    thickness: float,
    fidelity: str,
) -> Seeds:
    """Give every disc its radius; leave out those that overlap others too much."""
    has_map = ctx.gaussians is not None and len(ctx.map) > 0
    xyz, radius = (
        (ctx.map.xyz_W, ctx.map.radius_m) if has_map else (seeds.xyz_W[:0], seeds.opacity[:0])
    )
    # only opaque discs cover a surface
    solid = ctx.map.opacity > 0.5 if fidelity != "code" and has_map else None
    is_transparent = seeds.opacity < 0.5
    gaps = gaps_around(seeds.xyz_W, xyz, radius, obstacles=solid)
    size = gaps.size_m.clamp(min_radius_m, max_radius_m)
    size = torch.where(
        is_transparent, size.clamp(max=max(transparent_radius_m, min_radius_m)), size
    )
    seeds = dataclasses.replace(
        seeds,
        scale_m=torch.stack([size, size, thickness * size], dim=1),
    )
    if fidelity == "code":
        return seeds[~gaps.overlaps]
    if fidelity == "measured":
        return seeds[torch.where(is_transparent, ~_on_transparent(ctx, seeds), ~gaps.overlaps)]
    return seeds


def _on_transparent(ctx: SeedContext, seeds: Seeds) -> Bool[Tensor, " M"]:
    """Whether each new disc lies within the reach of a transparent one of a map whose rows have
    states."""
    if ctx.gaussians is None or ctx.map.state is None:
        return torch.zeros_like(seeds.opacity, dtype=torch.bool)
    return is_near(ctx, seeds, ctx.map.opacity < 0.5, REACH)


def is_near(
    ctx: SeedContext, seeds: Seeds, discs: Bool[Tensor, " N"], reach: float
) -> Bool[Tensor, " M"]:
    """Whether each new disc lies within ``reach`` radii of one of the nearest of these discs of the
    map, of which ``NEIGHBOURS`` are looked at.

    Args:
        ctx: With a map.
        seeds: The new discs, M rows.
        discs: Which discs of the map count. [N]
        reach: In units of the radius of a disc of the map.
    """
    rows = discs.nonzero().squeeze(1)
    if len(rows) and len(seeds):  # those that reach no new disc need no search
        reach_m = reach * float(ctx.map.radius_m[rows].nan_to_num(0.0).max())
        rows = rows[in_box(ctx.map.xyz_W[rows], seeds.xyz_W, reach_m + BORDER_M)]
    distance, row = k_nearest(seeds.xyz_W, ctx.map.xyz_W[rows], NEIGHBOURS)
    none = seeds.opacity.new_zeros(1)  # where there are fewer, ``row`` is one beyond the last
    radius = torch.cat([ctx.map.radius_m[rows], none])
    return (distance < reach * radius[row]).any(dim=1)


def in_box(
    xyz_W: Float[Tensor, "N 3"], around_W: Float[Tensor, "M 3"], border_m: float
) -> Bool[Tensor, " N"]:
    """Which points lie in the bounding box of ``around_W``, at least one point, or at most
    ``border_m`` outside it."""
    low = around_W.amin(0) - border_m
    high = around_W.amax(0) + border_m
    is_inside = torch.ones(len(xyz_W), dtype=torch.bool, device=xyz_W.device)
    for x, least, most in zip(xyz_W.unbind(1), low, high, strict=True):
        is_inside = is_inside & (x >= least) & (x <= most)
    return is_inside


def _decide_by_hit(
    ctx: SeedContext, view: SurfaceView, seeds: Seeds, pixel: Tensor, depth_error_m: float
) -> Float[Tensor, " M"]:
    """Opacity by the disc that the pixel's ray hits: transparent on a stable disc, 0 (none) on an
    unstable one."""
    disc = view.hit_index.flatten()[pixel]
    state = ctx.map.state
    stable = (
        torch.ones_like(disc, dtype=torch.bool)
        if state is None
        else state[disc.clamp_min(0)] == STABLE
    )
    opacity = torch.where((disc >= 0) & stable, TRANSPARENT_OPACITY, 0.0).to(seeds.opacity)
    return torch.where(seeds.tag == COLOUR_ERROR, opacity, seeds.opacity)


def _decide_by_plane(
    ctx: SeedContext, view: SurfaceView, seeds: Seeds, pixel: Tensor, depth_error_m: float
) -> Float[Tensor, " M"]:
    """Opacity as the released code decides: 0 near an unstable disc; transparent near a stable
    disc's plane."""
    unstable = (
        torch.zeros(len(ctx.map), dtype=torch.bool)
        if ctx.map.state is None
        else ctx.map.state == UNSTABLE
    )
    unstable = unstable.to(pixel.device)
    is_crowded = is_near(ctx, seeds, unstable, UNSTABLE_REACH)

    stable_rows = (~unstable).nonzero().squeeze(1)
    opacity = seeds.opacity.clone()
    if len(stable_rows):
        stable_view = disc_view(ctx, rows=stable_rows)
        stable_disc = stable_view.dominant_index.flatten()[pixel]
        row = stable_rows[stable_disc.clamp_min(0)]
        normal = ctx.map.normal_W[row]
        off_plane = ((ctx.map.xyz_W[row] - seeds.xyz_W) * normal).sum(dim=1).abs()
        opacity[(stable_disc >= 0) & (off_plane < 0.5 * depth_error_m)] = TRANSPARENT_OPACITY
    opacity[is_crowded] = 0.0
    return opacity


@dataclass(frozen=True, kw_only=True, eq=False)
class Gaps:
    """Free space around new points."""

    gap_m: Float[Tensor, "M K"]
    """Distance to each of the nearest neighbours minus the radius that it covers; negative inside
    it, metres."""

    @property
    def overlaps(self) -> Bool[Tensor, " M"]:
        """Whether the point lies within a neighbour's reach."""
        return (self.gap_m < 0).any(dim=1)

    @property
    def size_m(self) -> Float[Tensor, " M"]:
        """Root mean square of the gaps, where a negative gap counts as 0, metres."""
        return self.gap_m.clamp_min(0.0).square().mean(dim=1).sqrt()


def gaps_around(
    xyz_W: Float[Tensor, "M 3"],
    neighbour_xyz_W: Float[Tensor, "N 3"],
    neighbour_radius_m: Float[Tensor, " N"],
    *,
    obstacles: Bool[Tensor, " N"] | None = None,
    reach: float = REACH,
    neighbours: int = NEIGHBOURS,
) -> Gaps:
    """d_i = |x - x_i| - reach r_i for the nearest centres x_i, other new points (r = 0) and
    existing discs alike.

    Args:
        xyz_W: New points, metres.
        neighbour_xyz_W: Centres of the discs that exist.
        neighbour_radius_m: Their radii.
        obstacles: Which of them count; all by default.
        reach: An existing disc covers the space within this many of its radii.
        neighbours: Number of nearest neighbours; fewer if there are fewer points.

    Differentiable: no. Source: the released code (the paper says "cover the scene ... with little
    overlapping").
    """
    M = len(xyz_W)
    if M == 0:
        return Gaps(gap_m=xyz_W.new_zeros(0, neighbours))
    counts = in_box(neighbour_xyz_W, xyz_W, BORDER_M)
    if obstacles is not None:
        counts = obstacles & counts
    k = min(neighbours, M + int(counts.sum()) - 1)
    if k == 0:
        return Gaps(gap_m=xyz_W.new_full((1, 1), torch.inf))
    found = nearest_others(xyz_W, neighbour_xyz_W[counts], k)
    radius = torch.cat([xyz_W.new_zeros(M), neighbour_radius_m[counts]])
    return Gaps(gap_m=found.distance_m - reach * radius[found.row])
