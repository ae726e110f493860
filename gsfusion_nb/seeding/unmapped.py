"""Pixels that the map does not show yet: SplaTAM's densification mask, which many systems have taken over."""

from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .context import SeedContext


def unmapped_pixels(
    ctx: SeedContext,
    min_alpha: float,
    median_factor: float,
    *,
    sides: Literal["in front", "both"] = "in front",
    median_of: Literal["all", "measured"] = "all",
) -> Bool[Tensor, "H W"]:
    """Pixels with depth that the map does not cover, or where its depth is wrong by far.

        A < min_alpha   or   ( D^ > D  and  e > median_factor * median(e) ),      e = |D^ - D|, 0 where D is missing

    A is the accumulated opacity of the map, D^ its blended depth sum w_k z_k (not divided by A, as SplaTAM renders it),
    D the measured depth. Without a map: all pixels with depth.

    Args:
        ctx: Frame and map.
        min_alpha: Pixels whose A is smaller are not covered.
        median_factor: How many medians an error must exceed.
        sides: "in front": only where the measured surface lies in front of the map's (D < D^); "both": on both sides.
        median_of: "all": the median over all pixels, where those without depth count as 0, as in the released codes: if
            more than half of the depth is missing it is 0, and then every pixel with D < D^ is chosen; "measured": over
            the pixels with depth.

    Source: Keetha et al. 2024 (SplaTAM), Gaussian densification; the released code.
    """
    known = ctx.has_depth()
    if not ctx.has_map:
        return known
    view = ctx.render()
    e = depth_error_m(ctx)
    large = e > median_factor * _median(e if median_of == "all" else e[known])
    if sides == "in front":
        large &= view.depth_m > ctx.frame.depth_m
    return known & ((view.alpha < min_alpha) | large)


def depth_error_m(ctx: SeedContext) -> Float[Tensor, "H W"]:
    """|D^ - D| of the map's blended depth, metres; 0 where the frame has no depth. [H, W]"""
    return torch.where(ctx.has_depth(), (ctx.render().depth_m - ctx.frame.depth_m).abs(), 0.0)


def _median(values: Tensor) -> float:
    """The median, of an even number of values the smaller one of the middle two; infinite without any."""
    return float(values.median()) if values.numel() else torch.inf
