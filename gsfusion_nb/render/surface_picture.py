"""The surface as a camera sees it, made the base of a picture: its holes are filled, and half a
picture is enlarged.

A raycast leaves holes where no surface was fused: no depth, too far, glass. There the released code
of GPS-SLAM draws black with weight 1, which no Gaussian can quite cover. Filled by push-pull
(Gortler et al. 1996, The Lumigraph) a hole has the colours around it.
"""

from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from ..backends import op
from ..checks import check_number
from ..errors import ArgumentError
from ..geometry.operands import check_operand
from .over_base import Base

Holes = Literal["filled", "black", "gaussians"]

SAME_SURFACE = 0.03
"""Depths that differ by less than this share belong to the same surface when a picture is
enlarged."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfacePicture:
    """What a frame's camera sees of the surface below the Gaussians."""

    base: Base
    depth_everywhere_m: Float[Tensor, "H W"]
    """Depth of the surface, continued over the holes; 0 if nothing is known at all."""
    behind_m: float
    """Gaussians farther than this behind the surface are hidden, metres."""


def check_surface_picture(
    rgb: Any,
    depth_m: Any,
    size: Any,
    holes: Any,
    behind_m: Any,
) -> None:
    """Raise ``ValueError`` for arguments that ``surface_picture`` refuses."""
    check_operand("rgb", rgb, ("h", "w", 3))
    small = tuple(rgb.shape[:2])
    check_operand("depth_m", depth_m, small, dtypes=(rgb.dtype,), device=rgb.device)
    if small not in (tuple(size), tuple((n + 1) // 2 for n in size)):
        raise ArgumentError(
            f"the surface must be as large as the picture {tuple(size)} or half of it, got {small}"
        )
    if holes not in get_args(Holes):
        raise ArgumentError(f"holes must be one of {', '.join(get_args(Holes))}, got {holes!r}")
    check_number("behind_m", behind_m, 0)


@op("surface_picture", check_surface_picture)
def surface_picture(
    rgb: Float[Tensor, "h w 3"],
    depth_m: Float[Tensor, "h w"],
    size: tuple[int, int],
    holes: Holes,
    behind_m: float,
) -> SurfacePicture:
    """The base of a picture from the surface that its camera sees, at the picture's size or at half
    of it.

    Args:
        rgb, depth_m: Colour and z-depth of the surface, 0 where there is none. [h, w]
        size: Height and width of the picture.
        holes: Where no surface is: "filled" with the colours around, weight 1; "black", weight 1
            (released code); "gaussians": weight 0, so that only Gaussians count.
        behind_m: For the result.
    """
    has_depth = depth_m > 0
    image = torch.cat([rgb, depth_m[..., None]], dim=-1)
    if not bool(has_depth.all()):
        image = fill(image, has_depth)
    if depth_m.shape != size:
        image, has_depth = enlarge(image, has_depth, size)
    weight = torch.ones_like(image[..., 0]) if holes != "gaussians" else has_depth.to(image)
    colour = (
        image[..., :3]
        if holes == "filled"
        else torch.where(has_depth[..., None], image[..., :3], 0.0)
    )
    base = Base(
        rgb=colour.contiguous(),
        depth_m=torch.where(has_depth, image[..., 3], 0.0),
        weight=weight,
    )
    return SurfacePicture(
        base=base, depth_everywhere_m=image[..., 3].contiguous(), behind_m=behind_m
    )


def fill(
    image: Float[Tensor, "H W C"],
    has_value: Bool[Tensor, "H W"],
) -> Float[Tensor, "H W C"]:
    """The image with smooth values where they are not known: push-pull.

    Pull: halve the picture until one pixel is left, each time with the mean of the known ones of
    four. Push: back up, each unknown pixel takes the value that is interpolated from the smaller
    picture. Zero if nothing is known.
    """
    x = image.permute(2, 0, 1)[None]
    w = has_value[None, None].to(image)
    levels = [(x, w)]
    while max(x.shape[2:]) > 1:
        both = avg_pool2d(
            torch.cat([x * w, w], dim=1),
            2,
            ceil_mode=True,
            count_include_pad=False,
        )
        total = both[:, -1:]
        x = both[:, :-1] / total.clamp_min(1e-6)
        w = (total > 0).to(image)
        levels.append((x, w))
    weighted_x = x * w
    for x, w in reversed(levels[:-1]):
        coarse = interpolate(weighted_x, size=x.shape[2:], mode="bilinear", align_corners=False)
        weighted_x = torch.where(w > 0, x, coarse)
    return weighted_x[0].permute(1, 2, 0)


def enlarge(
    image: Float[Tensor, "h w C"],
    has_value: Bool[Tensor, "h w"],
    size: tuple[int, int],
) -> tuple[Float[Tensor, "H W C"], Bool[Tensor, "H W"]]:
    """A picture of half the size, enlarged; its last channel is depth. Colours do not run over a
    step in depth.

    Each large pixel lies in a small one, its own, and takes the mean of that and the three others
    around it, weighted by 9, 3, 3 and 1, without those that lie on another surface or are known
    where its own is not.

    Returns:
        The image, and which of its pixels are known: those whose own small pixel is.
    """
    h, w = has_value.shape
    padded = pad(
        image.permute(2, 0, 1)[None],
        (1, 1, 1, 1),
        mode="replicate",
    )[0].permute(1, 2, 0)
    neighbours = (
        pad(
            has_value[None, None].to(image),
            (1, 1, 1, 1),
            mode="replicate",
        )[0, 0]
        > 0
    )
    z = image[..., -1]
    large = image.new_empty(2 * h, 2 * w, image.shape[-1])
    for row_parity in (0, 1):
        for right in (0, 1):
            total = torch.full_like(z, 9.0)
            sum_ = 9.0 * image
            for i, j, share in (
                (2 * row_parity, 1, 3.0),
                (1, 2 * right, 3.0),
                (2 * row_parity, 2 * right, 1.0),
            ):
                shift = padded[i : i + h, j : j + w]
                same = ((shift[..., -1] - z).abs() < SAME_SURFACE * z) & (
                    neighbours[i : i + h, j : j + w] == has_value
                )
                sum_ = sum_ + share * same[..., None] * shift
                total = total + share * same
            large[row_parity::2, right::2] = sum_ / total[..., None]
    has_value = has_value.repeat_interleave(2, 0).repeat_interleave(2, 1)
    return large[: size[0], : size[1]], has_value[: size[0], : size[1]]
