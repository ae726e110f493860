"""Gradients through the blending, one pixel or one Gaussian at a time: the terms of the renderer's gradient.

With v_C = dL/dC at a pixel (``render.composite`` has the derivation):

    dL/dc_k     = w_k v_C
    dL/dalpha_k = T_k (c_k . v_C) - S_k / (1 - alpha_k),   S_k = sum_{j>k} w_j (c_j . v_C)
    dalpha/du   = alpha (A dx + B dy),   dalpha/dv = alpha (B dx + C dy),   dalpha/do = alpha / o
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ...constants import ALPHA_MAX
from ...drawing.page import html_table
from .pixel_stack import CELL_STYLE, Blend, PixelStack, Splats, blend_at, blend_pixel, stack_of, swatch

FIELD_WORK = 150_000
"""Most pairs of pixel and Gaussian that are evaluated; beyond, only every n-th pixel is."""


def blend_vjp(
    splats: Splats, blend: Blend, v_colour: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, "P K"], Float[Tensor, "P K 2"]]:
    """dL/dalpha_k and dL/d(u_k, v_k) of every Gaussian from every pixel, not summed."""
    alpha, T, w = blend.alpha, blend.transmittance[:, :-1], blend.weight
    c_dot_v = v_colour @ splats.rgb[blend.row].T
    wcv = w * c_dot_v
    S = wcv.flip(1).cumsum(1).flip(1) - wcv
    v_alpha = T * c_dot_v - S / (1.0 - alpha)
    v_alpha = torch.where((alpha > 0) & (alpha < ALPHA_MAX), v_alpha, 0.0)  # cut and clamp have slope zero
    A, B, C = splats.projection.conic[blend.row].unbind(-1)
    dx, dy = blend.offset_px.unbind(-1)
    slope = torch.stack([A * dx + B * dy, B * dx + C * dy], -1)
    return v_alpha, (v_alpha * alpha)[..., None] * slope


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelGradient:
    """The gradient from one pixel for the Gaussians of its stack, nearest first. A notebook shows it as a table."""

    stack: PixelStack
    v_colour: Float[Tensor, "3"]
    """dL/dC of the pixel."""
    v_rgb: Float[Tensor, "K 3"]
    v_alpha: Float[Tensor, " K"]
    v_opacity: Float[Tensor, " K"]
    v_uv: Float[Tensor, "K 2"]

    def _repr_html_(self) -> str:
        return pixel_gradient_table(self)


def pixel_gradient(splats: Splats, v_rgb: Float[Tensor, "H W 3"], u: int, v: int) -> PixelGradient:
    """The gradient from pixel (column ``u``, row ``v``) for each Gaussian that made it.

    Args:
        splats: The Gaussians on the screen.
        v_rgb: dL/d of the rendered image.
    """
    blend = blend_pixel(splats, u, v)
    stack = stack_of(splats, blend, u, v)
    v_C = v_rgb[v, u].to(stack.rgb)
    v_alpha, v_uv = blend_vjp(splats, blend, v_C[None])
    return PixelGradient(
        stack=stack, v_colour=v_C, v_rgb=stack.weight[:, None] * v_C, v_alpha=v_alpha[0],
        v_opacity=v_alpha[0] * stack.alpha / splats.projection.opacity[stack.row], v_uv=v_uv[0],
    )  # fmt: skip


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
    p, camera = splats.projection, splats.camera
    if not 0 <= row < len(p.depth_m):
        raise ValueError(f"row must be 0..{len(p.depth_m) - 1}, got {row}")
    low, high = p.uv[row] - p.extent_px[row], p.uv[row] + p.extent_px[row]
    size = low.new_tensor([camera.width, camera.height])
    first = (low - 0.5).ceil().clamp(min=0).minimum(size)
    last = (high - 0.5).floor().minimum(size - 1)
    if not bool(p.visible[row]) or bool((last < first).any()):
        raise ValueError(f"Gaussian {row} is not in the picture")
    crossing = (p.visible & ((p.uv - p.extent_px) < high).all(1) & ((p.uv + p.extent_px) > low).all(1)).sum()
    n_pixels = float((last - first + 1).prod())
    stride = max(1, round((n_pixels * float(crossing) / FIELD_WORK) ** 0.5))
    x = torch.arange(int(first[0]), int(last[0]) + 1, stride, device=low.device) + 0.5
    y = torch.arange(int(first[1]), int(last[1]) + 1, stride, device=low.device) + 0.5
    v, u = torch.meshgrid(y, x, indexing="ij")
    uv = torch.stack([u, v], -1).to(p.uv)
    blend = blend_at(splats, uv.view(-1, 2))
    v_C = v_rgb[v.long(), u.long()].view(-1, 3).to(p.uv)
    v_alpha, v_uv = blend_vjp(splats, blend, v_C)
    mine = (blend.row == row).to(p.uv)  # all zero if no pixel of the grid sees it
    shape = uv.shape[:2]
    return GaussianGradient(
        row=row, uv=uv, stride=stride, weight=(blend.weight @ mine).view(shape), v_alpha=(v_alpha @ mine).view(shape),
        v_uv=torch.einsum("pkc,k->pc", v_uv, mine).view(*shape, 2),
    )  # fmt: skip


def pixel_gradient_table(gradient: PixelGradient, rows: int = 12, unit: float | int = 1.0) -> str:
    """The gradients as an HTML table.

    Args:
        gradient: From ``pixel_gradient``.
        rows: Number of lines: the Gaussians with the largest weights, nearest first.
        unit: Numbers are divided by this: 1 / (number of values) turns an L1 gradient into +1 and -1.
    """
    s = gradient.stack
    heads = ("k", "row", "w", "dL/dα", "descent makes it", "dL/do", "dL/du", "dL/dv", "c now", "dL/dr, dL/dg, dL/db")
    lines = []
    keep = s.weight.argsort(descending=True)[:rows].sort().values.tolist()
    for k in keep:
        a, o = float(gradient.v_alpha[k]) / unit, float(gradient.v_opacity[k]) / unit
        u, v = (gradient.v_uv[k] / unit).tolist()
        wish = "no change" if abs(a) < 1e-9 else ("more opaque" if a < 0 else "less opaque")
        rgb = " ".join(f"{float(x) / unit:+.3f}" for x in gradient.v_rgb[k])
        numbers = (f"{a:+.3f}", wish, f"{o:+.3f}", f"{u:+.3f}", f"{v:+.3f}")
        lines.append((str(k), str(int(s.row[k])), f"{float(s.weight[k]):.3f}", *numbers, swatch(s.rgb[k]), rgb))
    foot = f"… {len(s) - len(keep)} more with smaller weights" if len(keep) < len(s) else ""
    looks = {"name": "gsnb-pixel-gradient", "style": "font-size:12px", "cell_style": CELL_STYLE}
    return html_table(lines, heads=heads, foot=foot, **looks)
