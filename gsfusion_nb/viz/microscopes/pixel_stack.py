"""Which Gaussians made a pixel: the blending of a few pixels, evaluated one Gaussian at a time.

The renderer does not record which Gaussians contributed to a pixel. Here every Gaussian is evaluated at the chosen
pixels, with the formulas of ``render.composite`` but without the lists of the tiles: a Gaussian that is missing in a
list is seen here.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from markupsafe import Markup
from torch import Tensor

from ...drawing.page import html_table
from ...geometry.spherical_harmonics import sh_to_rgb
from ...render import Projection, blend_rows, project_gaussians
from ...types import Camera, GaussianParams

TABLE_ROWS = 14
"""Rows of the table; the rest is summed up in one line."""
CELL_STYLE = "text-align:right;padding:1px 8px;line-height:1.35"
"""CSS of the cells of the microscopes' tables."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Splats:
    """A Gaussian map as a camera sees it, before blending: ellipses and colours."""

    projection: Projection
    rgb: Float[Tensor, "N 3"]
    camera: Camera


def project_splats(params: GaussianParams, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> Splats:
    """The first two stages of ``render``: EWA projection and the colour seen from this camera."""
    T_WC = T_WC.to(params.xyz_W)
    return Splats(
        projection=project_gaussians(params, camera, T_WC),
        rgb=sh_to_rgb(params.sh, params.xyz_W, T_WC[:3, 3]),
        camera=camera,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Blend:
    """The terms of ``C = sum_k w_k c_k`` at P pixels. Column k is one Gaussian, nearest first."""

    row: Int[Tensor, " K"]
    """Row in the map."""
    offset_px: Float[Tensor, "P K 2"]
    """(dx, dy) = pixel centre - (u, v)."""
    alpha: Float[Tensor, "P K"]
    """Zero where below 1/255 and where blending had already stopped."""
    transmittance: Float[Tensor, "P K+1"]
    """T_k in front of each; the last column is the transmittance behind all."""

    @property
    def weight(self) -> Float[Tensor, "P K"]:
        """w_k = alpha_k T_k."""
        return self.alpha * self.transmittance[:, :-1]


def blend_at(splats: Splats, uv: Float[Tensor, "P 2"]) -> Blend:
    """Blend every Gaussian that reaches one of the pixel centres ``uv`` (Kerbl et al. 2023, eq. 2-3).

    Args:
        splats: Ellipses and colours.
        uv: Pixel centres (i + 0.5, j + 0.5), pixels. [P, 2]

    Differentiable: no.
    """
    p = splats.projection
    low, high = uv.amin(0) - p.extent_px, uv.amax(0) + p.extent_px
    near = p.visible & (p.uv >= low).all(1) & (p.uv <= high).all(1)
    row = near.nonzero().squeeze(1)
    row = row[p.depth_m[row].argsort(stable=True)]
    x, y = uv.floor().long().unbind(-1)
    alpha, _, weight = blend_rows(p.uv[row], p.conic[row], p.opacity[row], x, y)
    alpha = torch.where(weight > 0, alpha, 0.0).T
    one = alpha.new_ones(len(uv), 1)
    T = torch.cat([one, (1.0 - alpha).cumprod(1)], dim=1)
    used = (alpha > 0).any(0)
    return Blend(
        row=row[used],
        offset_px=(uv[:, None] - p.uv[row])[:, used],
        alpha=alpha[:, used],
        transmittance=torch.cat([T[:, :-1][:, used], T[:, -1:]], dim=1),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelStack:
    """The Gaussians that made one pixel, nearest first, K of them. A notebook shows it as a table."""

    u: int
    """Pixel column."""
    v: int
    """Pixel row."""
    row: Int[Tensor, " K"]
    depth_m: Float[Tensor, " K"]
    alpha: Float[Tensor, " K"]
    transmittance: Float[Tensor, " K"]
    """T_k, the light left in front of each."""
    weight: Float[Tensor, " K"]
    """w_k = alpha_k T_k."""
    rgb: Float[Tensor, "K 3"]
    """c_k."""
    light_left: float
    """T behind all of them: the weight of the black background."""

    def __len__(self) -> int:
        return self.row.shape[0]

    @property
    def contribution(self) -> Float[Tensor, "K 3"]:
        """w_k c_k: what each adds to the pixel."""
        return self.weight[:, None] * self.rgb

    @property
    def colour(self) -> Float[Tensor, "3"]:
        """Their sum: the colour of the pixel."""
        return self.contribution.sum(0)

    def __repr__(self) -> str:
        r, g, b = self.colour.tolist()
        return f"PixelStack(pixel ({self.u}, {self.v}), {len(self)} Gaussians, colour {r:.3f} {g:.3f} {b:.3f})"

    def _repr_html_(self) -> str:
        return stack_table(self)


def pixel_stack(splats: Splats, u: int, v: int) -> PixelStack:
    """The stack of Gaussians behind pixel (column ``u``, row ``v``).

    Raises:
        ValueError: the pixel is not in the picture.
    """
    return stack_of(splats, blend_pixel(splats, u, v), u, v)


def blend_pixel(splats: Splats, u: int, v: int) -> Blend:
    """``blend_at`` the centre of one pixel.

    Raises:
        ValueError: the pixel is not in the picture.
    """
    check_pixel(splats.camera, u, v)
    return blend_at(splats, splats.projection.uv.new_tensor([[u + 0.5, v + 0.5]]))


def stack_of(splats: Splats, blend: Blend, u: int, v: int) -> PixelStack:
    """The stack of pixel (u, v) from its ``blend_pixel``."""
    return PixelStack(
        u=u, v=v, row=blend.row, depth_m=splats.projection.depth_m[blend.row], alpha=blend.alpha[0],
        transmittance=blend.transmittance[0, :-1], weight=blend.weight[0], rgb=splats.rgb[blend.row],
        light_left=float(blend.transmittance[0, -1]),
    )  # fmt: skip


def check_pixel(camera: Camera, u: int, v: int) -> None:
    """Raise ``ValueError`` unless the picture has pixel (u, v)."""
    if not (0 <= u < camera.width and 0 <= v < camera.height):
        raise ValueError(
            f"pixel ({u}, {v}) is outside the picture: columns 0..{camera.width - 1}, rows 0..{camera.height - 1}"
        )


def stack_table(stack: PixelStack, rows: int = TABLE_ROWS) -> str:
    """The stack as an HTML table: row, depth, alpha, T, weight, colour, contribution, and the sum below."""
    index = Markup("{}<sub>k</sub>")
    heads = (
        "k",
        "row",
        "depth m",
        index.format("α"),
        index.format("T"),
        index.format("w") + " = α T",
        index.format("c"),
    )
    shown = min(len(stack), rows)
    lines: list[tuple[str, ...]] = []
    for k in range(shown):
        numbers = (f"{x[k]:.3f}" for x in (stack.depth_m, stack.alpha, stack.transmittance, stack.weight))
        lines.append((str(k), str(int(stack.row[k])), *numbers, swatch(stack.rgb[k]), rgb_text(stack.contribution[k])))
    if shown < len(stack):
        weight, contribution = stack.weight[shown:].sum(), stack.contribution[shown:].sum(0)
        more = f"… {len(stack) - shown} more"
        lines.append(("", more, "", "", "", f"{weight:.3f}", "", rgb_text(contribution)))
    total = (
        "", "sum", "", "", f"left {stack.light_left:.3f}", f"{stack.weight.sum():.3f}",
        swatch(stack.colour), rgb_text(stack.colour),
    )  # fmt: skip
    lines.append(tuple(Markup("<b>{}</b>").format(x) for x in total))
    return html_table(lines, heads=(*heads, "w c"), name="gsnb-stack", style="font-size:12px", cell_style=CELL_STYLE)


def swatch(rgb: Float[Tensor, "3"]) -> Markup:
    """A small square of a colour, as HTML."""
    r, g, b = (round(255 * min(max(float(x), 0.0), 1.0)) for x in rgb)
    style = f"display:inline-block;width:26px;height:12px;border:1px solid #8888;background:rgb({r},{g},{b})"
    return Markup('<span style="{}"></span>').format(style)


def rgb_text(rgb: Tensor) -> str:
    """A colour as three numbers."""
    return " ".join(f"{float(x):.3f}" for x in rgb)
