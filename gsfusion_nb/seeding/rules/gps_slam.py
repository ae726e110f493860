"""GPS-SLAM's rule: discs on the surface of the TSDF where the colour is wrong."""

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...geometry import normals_at, se3
from ...types import Seeds
from ..context import SeedContext
from ..discs import as_discs
from ..draws import draw_rows
from ..map_queries import picture_over_surface, surface_inputs
from ..map_rule import MapRule, When, every
from ..rule import seeding_rule, trained_otherwise
from ..shapes import sized_by_neighbours
from ..volume_queries import raycast_volume

MAX_DEPTH_M = 5.0
THICKNESS = 0.1
ERROR_SEEN_BEFORE = 3.0
"""Where the map had its chance, in a view that was seen before, the error must be so many times as
large."""


@trained_otherwise("a residual over the TSDF's colours, 20 steps every 10 frames")
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class gps_slam(MapRule):
    """GPS-SLAM: every 10 frames, discs on the TSDF's surface for a quarter of the pixels whose
    colour is wrong.

    A random 25 % of the pixels whose mean colour error is above 0.05, where the TSDF has a surface
    nearer than 5 m and the weights of the Gaussians there add up to less than 5. Discs on that
    surface, along its normal, as large as the root mean square distance to their 3 nearest
    neighbours among the new ones, but at most 1 cm; 0.1 of that thick.

    In the system gps_slam the error is that of its picture, the TSDF's colour and the Gaussians
    over it. In the other systems opacities do not sum to more than 1, so the test of the weights is
    left out, and ``base`` says what the error is measured against.

    Args:
        colour_error: Mean over R, G, B of |C^ - C| (0..1) above which a pixel is a candidate.
            Release: 0.05.
        share: Share of the candidates that is drawn at random, 0..1. Release: 0.25.
        most: At most this share of the image's pixels is drawn, 0..1. Smaller: where poses or depth
            are noisy, so that colours are wrong nearly everywhere, Gaussians stay as few as
            elsewhere. Release: no limit.
        max_weight: Only in the system gps_slam: no discs where the weights add up to this or more.
            Larger: more Gaussians. Paper 4, release 5, RRG-SLAM 3; 1 needs the fewest.
        in_holes: Only in the system gps_slam: also seed where the TSDF has no surface, at the
            measured depth, or without one at the depth around the hole. The release does not.
        opacity: Opacity of the discs. Release: 0.5.
        max_radius_m: Largest standard deviation, metres. Paper: 0.1. Release: 0.01, at 1200 x 680
            pixels; at 320 x 240 most discs would be larger.
        max_radius_px: A disc may also be this many pixels large, if that is more. Release: 0.
        base: What the error is measured against. "map": the picture of the Gaussians alone, since a
            mapper here draws nothing else; "tsdf": with the TSDF's colour where the Gaussians do
            not cover, as the release, whose picture is made of both.
        surface: "tsdf": positions and normals of the raycast TSDF, as in paper and release;
            "depth": of the depth image (as in the same group's next paper, RRG-SLAM), which needs
            no TSDF.
        only_with_depth: Leave out pixels without measured depth. The release seeds them where the
            TSDF has a surface.
        min_confidence: Only in voxels of the TSDF with at least this weight, its number of
            observations; 0: all. Larger: fewer discs, none where a surface was measured once by
            mistake, which a noisy camera does. With the colour error and a surface to lie on it is
            the third gate of AnythingReality (2607.09260), whose threshold was not found. Usual
            there: 2 to 5.

    Left out: removal of discs that are small (3 mm), large (10 cm) or transparent (0.005), which
    the system does. In the system gps_slam normals come from differences of the surface's points,
    as in the release, but of those beside the pixel instead of Sobel's 3x3; in the other systems
    from the TSDF's gradient, with ``surface`` "tsdf". A view that an earlier keyframe shows
    (``SurfaceInputs.seen_before``) needs three times the error, which is not released. Source: Peng
    et al. 2025 (GPS-SLAM) and its released code.
    """

    colour_error: float = 0.05
    share: float = 0.25
    most: float = 1.0
    max_weight: float = 5.0
    in_holes: bool = False
    opacity: float = 0.5
    max_radius_m: float = 0.01
    max_radius_px: float = 0.0
    base: Literal["map", "tsdf"] = "map"
    surface: Literal["tsdf", "depth"] = "tsdf"
    only_with_depth: bool = True
    min_confidence: float = 0.0

    when: ClassVar[When] = every(10)

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The discs of one mapped frame."""
        depth_m, candidates, normal_W = self._surface(ctx)
        in_range = (depth_m >= (ctx.near_m or 0.0)) & (depth_m > 0) & (depth_m < MAX_DEPTH_M)
        candidates = candidates & in_range
        if self.only_with_depth and not self.in_holes:
            candidates &= ctx.has_depth()
        row, column = candidates.nonzero(as_tuple=True)
        n_seeds = int(min(self.share * len(row), self.most * candidates.numel()))
        sample = draw_rows(ctx, len(row), n_seeds)
        row = row[sample]
        column = column[sample]
        uv = torch.stack([column, row], dim=-1) + 0.5
        seeds = ctx.seeds_at(uv, 1.0, depth_m=depth_m, opacity=self.opacity)
        if self.min_confidence > 0:
            is_sure = ctx.voxel_weight(seeds.xyz_W) >= self.min_confidence
            seeds = seeds[is_sure]
            row = row[is_sure]
            column = column[is_sure]
        # 1 px before it is sized
        most_m = (seeds.scale_m[:, 0] * self.max_radius_px).clamp(min=self.max_radius_m)
        seeds = sized_by_neighbours(ctx, seeds)
        seeds = dataclasses.replace(seeds, scale_m=torch.minimum(seeds.scale_m, most_m[:, None]))
        if normal_W is None:
            normals = se3.rotate(ctx.frame.T_WC, normals_at(ctx.camera, depth_m, row, column))
        else:
            normals = normal_W[row, column]
        return as_discs(ctx, seeds, normals, THICKNESS)

    def _surface(
        self,
        ctx: SeedContext,
    ) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"], Float[Tensor, "H W 3"] | None]:
        """Depth of the surface that discs lie on, the candidates, and the surface's normals; None:
        those of its depth."""
        inputs = surface_inputs(ctx)
        if inputs is None:
            candidates = self._error(ctx) > self.colour_error
            if self.surface == "depth":
                return ctx.frame.depth_m, candidates, ctx.normals_W()
            hits = raycast_volume(ctx)
            return hits.depth_m, candidates, hits.normal_W
        surface = inputs.surface
        picture = picture_over_surface(ctx)
        error = (picture.rgb - ctx.frame.rgb).abs().mean(dim=-1)
        min_error = self.colour_error * (ERROR_SEEN_BEFORE if inputs.seen_before else 1.0)
        candidates = (error > min_error) & (picture.weight < self.max_weight)
        depth_m = ctx.frame.depth_m if self.surface == "depth" else surface.base.depth_m
        # not while there is no surface at all
        if self.in_holes and bool((surface.base.depth_m > 0).any()):
            hole_depth_m = torch.where(
                ctx.has_depth(), ctx.frame.depth_m, surface.depth_everywhere_m
            )
            depth_m = torch.where(depth_m > 0, depth_m, hole_depth_m)
        else:
            candidates &= surface.base.depth_m > 0
        return depth_m, candidates, None

    def _error(self, ctx: SeedContext) -> Float[Tensor, "H W"]:
        """Mean absolute colour error of the picture that exists before this frame's discs."""
        rgb = torch.zeros_like(ctx.frame.rgb)
        alpha = torch.zeros_like(ctx.frame.depth_m)
        if ctx.has_map:
            view = ctx.render()
            rgb = view.rgb
            alpha = view.alpha
        if self.base == "tsdf":
            rgb = rgb + (1 - alpha)[..., None] * raycast_volume(ctx).rgb
        return (rgb - ctx.frame.rgb).abs().mean(dim=-1)
