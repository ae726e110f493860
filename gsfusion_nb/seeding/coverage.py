"""What the map covers of the frame: pixels that it does not show, or shows at a wrong depth, and
Gaussians before the surface."""

from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..geometry import project, se3
from .context import SeedContext


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
    has_depth = ctx.has_depth()
    if not ctx.has_map:
        return has_depth
    view = ctx.render()
    depth_m = view.depth_m / view.alpha.clamp_min(1e-6) if divided else view.depth_m
    e = depth_error_m(ctx, depth_m)
    large = e > median_factor * _median(e if median_of == "all" else e[has_depth])
    if sides == "in front":
        large &= depth_m > ctx.frame.depth_m
    return has_depth & ((view.alpha < min_alpha) | large)


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
    in_image = (
        (z > 0)
        & (uv >= 0).all(dim=1)
        & (uv < uv.new_tensor([ctx.camera.width, ctx.camera.height])).all(dim=1)
    )
    uv = torch.where(in_image[:, None], uv, 0.0)
    in_mask = ctx.has_depth() if where is None else ctx.has_depth() & where
    return (
        in_image
        & ctx.values_at(in_mask, uv)
        & (z < ctx.values_at(ctx.frame.depth_m, uv) - margin_m)
    )
