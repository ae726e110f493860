"""Gaussians that are as large as the pixel that they are made from."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..types import Seeds
from .context import SeedContext


def one_pixel_seeds(
    ctx: SeedContext, chosen: Bool[Tensor, "H W"], *, share: float = 1.0, every_px: int = 1, opacity: float = 0.5
) -> Seeds:
    """A round Gaussian for each chosen pixel with depth, standard deviation z / ((fx + fy) / 2): one pixel.

    Args:
        ctx: The frame.
        chosen: Pixels. [H, W]
        share: Share of them that is drawn at random, 0..1; sizes are 1 / sqrt(share) times as large, so that the
            Gaussians cover as much of the image.
        every_px: Only every n-th pixel of every n-th row, with n times the size.
        opacity: Peak opacity.

    Raises:
        ValueError: ``share`` not in 0..1, or ``every_px`` below 1.
    """
    if every_px < 1:
        raise ValueError(f"every_px must be at least 1, got {every_px}")
    if every_px > 1:
        grid = torch.zeros_like(chosen)
        grid[::every_px, ::every_px] = True
        chosen = chosen & grid
    return ctx.seeds_at(drawn_pixels(ctx, chosen, share), every_px * pixel_radius(ctx, share), opacity=opacity)


def drawn_pixels(ctx: SeedContext, chosen: Bool[Tensor, "H W"], share: float) -> Float[Tensor, "N 2"]:
    """Centres of the chosen pixels with depth, or of a random share of them, row by row.

    Raises:
        ValueError: ``share`` not in 0..1.
    """
    if not 0 < share <= 1:
        raise ValueError(f"share must be above 0 and at most 1, got {share}")
    uv = ctx.pixels(chosen)
    return uv if share == 1 else uv[ctx.draw(len(uv), round(share * len(uv)))]


def pixel_radius(ctx: SeedContext, share: float = 1.0) -> float:
    """The ``radius_px`` of ``ctx.seeds_at`` that gives z / ((fx + fy) / 2), times 1 / sqrt(share)."""
    return 2 * ctx.camera.fx / (ctx.camera.fx + ctx.camera.fy) / share**0.5  # seeds_at divides by fx
