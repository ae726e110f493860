"""The renderer's gradient before it is summed, by pixel and by Gaussian.

Its terms, with v_C = dL/dC at a pixel (``render.composite`` has the derivation):

    dL/dc_k     = w_k v_C
    dL/dalpha_k = T_k (c_k . v_C) - S_k / (1 - alpha_k),   S_k = sum_{j>k} w_j (c_j . v_C)
    dalpha/du   = alpha (A dx + B dy),   dalpha/dv = alpha (B dx + C dy),   dalpha/do = alpha / o
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from ...errors import ArgumentError
from ...render.composite import blend_vjp
from .pixel_blend import Blend, Splats, blend_at
from .pixel_stack import PixelStack, pixel_stack

FIELD_WORK = 150_000
"""Most pairs of pixel and Gaussian that are evaluated; beyond, only every n-th pixel is."""


def gradient_terms(
    splats: Splats, blend: Blend, v_colour: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, "P K"], Float[Tensor, "P K 2"]]:
    """dL/dalpha_k and dL/d(u_k, v_k) of every Gaussian from every pixel, not summed."""
    # neither depth nor opacity
    rgb, v_C = (pad(colour, (0, 2)) for colour in (splats.rgb[blend.row], v_colour))
    v_alpha = blend_vjp(blend.alpha.T, rgb, v_C)[0].T
    A, B, C = splats.projection.conic[blend.row].unbind(-1)
    dx, dy = blend.offset_px.unbind(-1)
    slope = torch.stack([A * dx + B * dy, B * dx + C * dy], -1)
    return v_alpha, (v_alpha * blend.alpha)[..., None] * slope


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelGradient:
    """The gradient from one pixel for the Gaussians of its stack, nearest first."""

    stack: PixelStack
    v_rgb: Float[Tensor, "K 3"]
    v_alpha: Float[Tensor, " K"]
    v_opacity: Float[Tensor, " K"]
    v_uv: Float[Tensor, "K 2"]


def pixel_gradient(
    splats: Splats,
    v_rgb: Float[Tensor, "H W 3"],
    u: int,
    v: int,
) -> PixelGradient:
    """The gradient from pixel (column ``u``, row ``v``) for each Gaussian that made it.

    Args:
        splats: The Gaussians on the screen.
        v_rgb: dL/d of the rendered image.
    """
    blend = blend_at(
        splats,
        splats.projection.uv.new_tensor([[u + 0.5, v + 0.5]]),
    )
    stack = pixel_stack(splats, u, v, blend)
    v_C = v_rgb[v, u].to(stack.rgb)
    v_alpha, v_uv = gradient_terms(splats, blend, v_C[None])
    return PixelGradient(
        stack=stack,
        v_rgb=stack.weight[:, None] * v_C,
        v_alpha=v_alpha[0],
        v_opacity=v_alpha[0] * stack.alpha / splats.projection.opacity[stack.row],
        v_uv=v_uv[0],
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianGradient:
    """The gradient that one Gaussian receives, pixel by pixel, on a grid of h x w pixels."""

    row: int
    uv: Float[Tensor, "h w 2"]
    """Pixel centres of the grid."""
    stride: int
    """Distance between the grid's pixels; only with 1 the sum is the renderer's gradient."""
    weight: Float[Tensor, "h w"]
    v_alpha: Float[Tensor, "h w"]
    v_uv: Float[Tensor, "h w 2"]


def gaussian_gradient(splats: Splats, v_rgb: Float[Tensor, "H W 3"], row: int) -> GaussianGradient:
    """The gradient for one Gaussian from every pixel under it.

    Args:
        splats: The Gaussians on the screen.
        v_rgb: dL/d of the rendered image.
        row: The Gaussian.

    Raises:
        ValueError: there is no such row, or it is not in the picture.
    """
    p = splats.projection
    camera = splats.camera
    if not 0 <= row < len(p.depth_m):
        raise ArgumentError(f"row must be 0..{len(p.depth_m) - 1}, got {row}")
    low = p.uv[row] - p.extent_px[row]
    high = p.uv[row] + p.extent_px[row]
    size = low.new_tensor([camera.width, camera.height])
    first = (low - 0.5).ceil().clamp(min=0).minimum(size)
    last = (high - 0.5).floor().minimum(size - 1)
    if not bool(p.visible[row]) or bool((last < first).any()):
        raise ArgumentError(f"Gaussian {row} is not in the picture")
    crossing = (
        p.visible & ((p.uv - p.extent_px) < high).all(1) & ((p.uv + p.extent_px) > low).all(1)
    ).sum()
    n_pixels = float((last - first + 1).prod())
    stride = max(1, round((n_pixels * float(crossing) / FIELD_WORK) ** 0.5))
    x = (
        torch.arange(
            int(first[0]),
            int(last[0]) + 1,
            stride,
            device=low.device,
        )
        + 0.5
    )
    y = (
        torch.arange(
            int(first[1]),
            int(last[1]) + 1,
            stride,
            device=low.device,
        )
        + 0.5
    )
    v, u = torch.meshgrid(y, x, indexing="ij")
    uv = torch.stack([u, v], -1).to(p.uv)
    blend = blend_at(splats, uv.view(-1, 2))
    v_C = v_rgb[v.long(), u.long()].view(-1, 3).to(p.uv)
    v_alpha, v_uv = gradient_terms(splats, blend, v_C)
    mine = (blend.row == row).to(p.uv)  # all zero if no pixel of the grid sees it
    shape = uv.shape[:2]
    return GaussianGradient(
        row=row,
        uv=uv,
        stride=stride,
        weight=(blend.weight @ mine).view(shape),
        v_alpha=(v_alpha @ mine).view(shape),
        v_uv=torch.einsum("pkc,k->pc", v_uv, mine).view(*shape, 2),
    )
