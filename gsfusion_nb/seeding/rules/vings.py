"""VINGS-Mono's rule: as many points as there are pixels with errors, drawn anywhere."""

import dataclasses

import torch

from ...geometry import quaternion
from ...types import Seeds
from ..context import SeedContext
from ..rule import seeding_rule
from ..sampling import sized_by_neighbours, thin, unmapped_pixels


@seeding_rule
def vings(
    ctx: SeedContext,
    *,
    share: float = 0.13,
    max_alpha: float = 0.98,
    median_factor: float = 10.0,
    colour_error: float = 0.1,
    thickness: float = 0.1,
    as_released: bool = True,
) -> Seeds:
    """VINGS-Mono: as many discs as there are pixels with errors, drawn from all pixels, of random orientation.

    Their number is ``share`` times the number of the image's pixels where

        A <= 0.98   or   |D^ - D| > 10 median |D^ - D|   or   sum over R, G, B of |C^ - C| > 0.1

    Their size is the root mean square distance to the 3 nearest new ones, the same on both axes of the disc, their
    opacity 0.8, in the first frame 0.1.

    Args:
        ctx: Frame and Gaussian map.
        share: Number of Gaussians as a share of the pixels that the test chooses. The release makes 40,000 Gaussians if
            all pixels are chosen, whatever the size of the image; that is 0.13 of 640 x 480 pixels.
        max_alpha: Pixels with an accumulated opacity A up to this are chosen. Release: 0.98.
        median_factor: How many medians a depth error must exceed, on either side. Release: 10.
        colour_error: Sum of the absolute colour errors (0..1 each) above which a pixel is chosen. Release: 0.1.
        thickness: Third standard deviation as a share of the other two. The release has flat Gaussians without one;
            0.1 is chosen here.
        as_released: The released code draws the points from all pixels with depth, so the test decides only how many
            there are. False draws them from the chosen pixels.

    Left out because the optimiser does it: pruning by size in the image, and training only unstable Gaussians with
    large errors. VINGS estimates depth; here it is measured. Its renderer divides the depth by A
    (``scripts/gaussian/gaussian_base.py``, ``render_raw``); here D^ is not divided, so that the depth test also chooses
    pixels that the map covers only in part.
    Source: the released code of VINGS-Mono.
    """
    chosen = known = ctx.has_depth()
    if ctx.has_map:
        view = ctx.render()
        wrong = (view.rgb - ctx.frame.rgb).abs().sum(dim=-1) > colour_error
        depth = unmapped_pixels(ctx, 0.0, median_factor, sides="both")
        chosen = known & ((view.alpha <= max_alpha) | depth | wrong)
    count = round(share * int(chosen.sum()))
    uv = ctx.pixels(known if as_released else chosen)
    uv = uv[ctx.draw(len(uv), count)]
    balls = sized_by_neighbours(ctx, ctx.seeds_at(uv, 1.0, opacity=0.8 if ctx.has_map else 0.1))
    generator = ctx.generator
    quat = torch.randn(len(balls), 4, generator=generator, device=generator.device).to(balls.quat)
    return dataclasses.replace(balls, quat=quaternion.normalise(quat), scale_m=thin(balls.scale_m, thickness))
