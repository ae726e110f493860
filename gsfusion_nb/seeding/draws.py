"""Rows and pixels drawn at random, without replacement."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..errors import ArgumentError
from ..types import Seeds
from .context import SeedContext
from .inputs import SeedInputs


def draw_rows(inputs: SeedInputs, n: int, count: int) -> Int[Tensor, " K"]:
    """``count`` of the numbers 0 .. n - 1 at random, without replacement, in increasing order; all
    if there are fewer. On the frame's device. [K]"""
    order = torch.randperm(n, generator=inputs.generator, device=inputs.generator.device)
    return order[: max(count, 0)].sort().values.to(inputs.frame.depth_m.device)


def draw_weighted_rows(
    inputs: SeedInputs, weight: Float[Tensor, " N"], count: int
) -> Int[Tensor, " K"]:
    """``count`` rows at random, without replacement, with probabilities in proportion to ``weight``
    (>= 0), in increasing order; rows of weight 0 are never drawn, so there may be fewer. [K]

    The ``count`` smallest of E_i / w_i with E_i exponentially distributed have this distribution
    (Efraimidis and Spirakis 2006).
    """
    uniform = torch.rand(
        len(weight), generator=inputs.generator, device=inputs.generator.device
    ).to(weight.device)
    key = -torch.log1p(-uniform) / weight
    key = torch.where(weight > 0, key, torch.inf)
    count = min(max(count, 0), int((weight > 0).sum()))
    return key.argsort(stable=True)[:count].sort().values


def one_pixel_seeds(
    ctx: SeedContext,
    mask: Bool[Tensor, "H W"],
    *,
    share: float = 1.0,
    every_px: int = 1,
    opacity: float = 0.5,
) -> Seeds:
    """A round Gaussian for each chosen pixel with depth, standard deviation z / ((fx + fy) / 2):
    one pixel.

    Args:
        ctx: The frame.
        mask: Pixels. [H, W]
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
        grid = torch.zeros_like(mask)
        grid[::every_px, ::every_px] = True
        mask = mask & grid
    return ctx.seeds_at(
        drawn_pixels(ctx, mask, share), every_px * pixel_radius(ctx, share), opacity=opacity
    )


def drawn_pixels(
    ctx: SeedContext, mask: Bool[Tensor, "H W"] | None, share: float
) -> Float[Tensor, "N 2"]:
    """Centres of the chosen pixels with depth (all without a choice), or of a random share of them,
    row by row.

    Raises:
        ValueError: ``share`` not in 0..1.
    """
    if not 0 < share <= 1:
        raise ArgumentError(f"share must be above 0 and at most 1, got {share}")
    uv = ctx.pixels(mask)
    return uv if share == 1 else uv[draw_rows(ctx, len(uv), round(share * len(uv)))]


def pixel_radius(ctx: SeedContext, share: float = 1.0) -> float:
    """The ``radius_px`` of ``ctx.seeds_at`` that gives z / ((fx + fy) / 2), times 1 /
    sqrt(share)."""
    # seeds_at divides by fx
    return 2 * ctx.camera.fx / (ctx.camera.fx + ctx.camera.fy) / share**0.5
