"""Which Gaussians made a pixel: the blending of a few pixels, one Gaussian at a time, as numbers
and as drawings.

The renderer does not record which Gaussians contributed to a pixel. Here every Gaussian is
evaluated at the chosen pixels, with the formulas of ``render.composite`` but without the lists of
the tiles: a Gaussian that is missing in a list is seen here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from markupsafe import Markup
from torch import Tensor

from ...drawing.curves import (
    BETWEEN,
    CARD_INK,
    PALETTE,
    card_figure,
    figure_picture,
    image_figure,
    style,
)
from ...drawing.page import html_table
from ...drawing.pictures import AnyImage, Picture, to_uint8
from ...errors import ArgumentError
from ...geometry.spherical_harmonics import sh_to_rgb
from ...render import Projection, blend_rows, project_gaussians
from ...render.composite import pixel_offsets, splat_alpha
from ...types import Camera, GaussianParams

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TABLE_ROWS = 14
"""Gaussians in a table; of the others their number is given."""


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
    """Blend every Gaussian that reaches one of the pixel centres ``uv`` (Kerbl et al. 2023, eq.
    2-3).

    Args:
        splats: Ellipses and colours.
        uv: Pixel centres (i + 0.5, j + 0.5), pixels. [P, 2]

    Differentiable: no.
    """
    p = splats.projection
    low = uv.amin(0) - p.extent_px
    high = uv.amax(0) + p.extent_px
    reaches = p.visible & (p.uv >= low).all(1) & (p.uv <= high).all(1)
    row = reaches.nonzero().squeeze(1)
    row = row[p.depth_m[row].argsort(stable=True)]
    x, y = uv.floor().long().unbind(-1)
    alpha, _, weight = blend_rows(
        p.uv[row],
        p.conic[row],
        p.opacity[row],
        x,
        y,
    )
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


def reaching(
    splats: Splats,
    u: int,
    v: int,
) -> tuple[Int[Tensor, " K"], Float[Tensor, " K"]]:
    """Rows of the Gaussians that reach the centre of pixel (u, v), in the order of the map, and
    their alpha there.

    Raises:
        ValueError: the pixel is not in the picture.
    """
    check_pixel(splats.camera, u, v)
    p = splats.projection
    row = (
        (p.visible & ((p.uv - p.uv.new_tensor([u + 0.5, v + 0.5])).abs() <= p.extent_px).all(1))
        .nonzero()
        .squeeze(1)
    )
    dx, dy = pixel_offsets(
        p.uv[row],
        torch.tensor([u]),
        torch.tensor([v]),
    )
    alpha = splat_alpha(
        dx,
        dy,
        p.conic[row],
        p.opacity[row],
    )[:, 0]
    return row[alpha > 0], alpha[alpha > 0]


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelStack:
    """The Gaussians that made one pixel, nearest first, K of them. A notebook shows it as a
    table."""

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
        return (
            f"PixelStack(pixel ({self.u}, {self.v}), {len(self)} Gaussians, colour {r:.3f} "
            f"{g:.3f} {b:.3f})"
        )

    @property
    def caption(self) -> str:
        """Number of Gaussians and their sum, as HTML."""
        return f"<b>{len(self)} Gaussians</b>, sum of w c = {rgb_text(self.colour)}"

    def graph(self, size: tuple[int, int]) -> Picture:
        """Bars of alpha and weight, nearest at the left, steps of the transmittance, and the colour
        as it builds up."""
        title = (
            "red: light left T, pale: alpha, full: weight w = alpha T; below: the colour "
            "summed up so far"
        )
        strips = {"sum": self.contribution.cumsum(0)}
        light = self.transmittance
        return weights_graph(
            size,
            self.rgb,
            self.weight,
            strips,
            title=title,
            alpha=self.alpha,
            light=light,
        )

    def _repr_html_(self) -> str:
        index = Markup("{}<sub>k</sub>")
        heads = (
            "k",
            "row",
            "depth m",
            index.format("α"),
            index.format("T"),
            index.format("w") + " = α T",
            index.format("c"),
            "w c",
        )
        numbers = (self.depth_m, self.alpha, self.transmittance, self.weight)
        lines = [
            (
                str(k),
                str(int(self.row[k])),
                *(f"{x[k]:.3f}" for x in numbers),
                swatch(self.rgb[k]),
                rgb_text(wc),
            )
            for k, wc in enumerate(self.contribution[:TABLE_ROWS])
        ]
        light_words = f"left {self.light_left:.3f}"
        weight = f"{self.weight.sum():.3f}"
        total = ("", "sum", "", "", light_words, weight, swatch(self.colour), rgb_text(self.colour))
        return numbers_table(heads, lines, total, n=len(self))


def pixel_stack(
    splats: Splats,
    u: int,
    v: int,
    blend: Blend | None = None,
) -> PixelStack:
    """The stack of Gaussians behind pixel (column ``u``, row ``v``); ``blend``: its ``blend_at``,
    if it is known.

    Raises:
        ValueError: the pixel is not in the picture.
    """
    check_pixel(splats.camera, u, v)
    b = blend or blend_at(
        splats,
        splats.projection.uv.new_tensor([[u + 0.5, v + 0.5]]),
    )
    return PixelStack(
        u=u,
        v=v,
        row=b.row,
        depth_m=splats.projection.depth_m[b.row],
        alpha=b.alpha[0],
        weight=b.weight[0],
        transmittance=b.transmittance[0, :-1],
        rgb=splats.rgb[b.row],
        light_left=float(b.transmittance[0, -1]),
    )


def check_pixel(camera: Camera, u: int, v: int) -> None:
    """Raise ``ValueError`` unless the picture has pixel (u, v)."""
    if not (0 <= u < camera.width and 0 <= v < camera.height):
        raise ArgumentError(
            f"pixel ({u}, {v}) is outside the picture: columns 0..{camera.width - 1}, rows "
            f"0..{camera.height - 1}"
        )


def numbers_table(
    heads: Sequence[str],
    lines: Sequence[tuple[str, ...]],
    total: tuple[str, ...] = (),
    *,
    n: int,
) -> str:
    """The table of a microscope: a line for each of the first of ``n`` Gaussians, and their
    total."""
    last = [tuple(Markup("<b>{}</b>").format(x) for x in total)] if total else []
    foot = f"and {n - TABLE_ROWS} more Gaussians" if n > TABLE_ROWS else ""
    style = "font-size:12px"
    cells = "text-align:right;padding:1px 8px;line-height:1.35"
    return html_table(
        [*lines, *last],
        heads=heads,
        foot=foot,
        name="gsnb-stack",
        style=style,
        cell_style=cells,
    )


def swatch(rgb: Float[Tensor, "3"]) -> Markup:
    """A small square of a colour, as HTML."""
    r, g, b = (round(255 * min(max(float(x), 0.0), 1.0)) for x in rgb)
    style = (
        "display:inline-block;width:26px;height:12px;border:1px solid "
        f"#8888;background:rgb({r},{g},{b})"
    )
    return Markup('<span style="{}"></span>').format(style)


def rgb_text(rgb: Tensor) -> str:
    """A colour as three numbers."""
    return " ".join(f"{float(x):.3f}" for x in rgb)


INK = "#1c2430"
CROSS = "#ffd200"
"""Lines in pictures, and the mark at the chosen pixel."""


def weights_graph(
    size: tuple[int, int],
    rgb: Float[Tensor, "K 3"],
    weight: Float[Tensor, " K"],
    strips: Mapping[str, Float[Tensor, "K 3"]],
    *,
    title: str,
    alpha: Float[Tensor, " K"] | None = None,
    light: Float[Tensor, " K"] | None = None,
) -> Picture:
    """One bar for each sample of a pixel in its colour, and below them strips: how its colour
    builds up.

    Args:
        size: Width and height, pixels.
        rgb, weight: Of each sample, in the order of blending.
        strips: Name -> colour after each sample.
        title: What the bars are.
        alpha: Pale bars behind those of the weights.
        light: Red steps: the light left in front of each sample.
    """
    figure, (bars, *strip_axes) = card_figure(
        *size,
        1 + len(strips),
        gridspec_kw={"height_ratios": (7, *[1] * len(strips))},
    )
    style(bars, title=title, ink=CARD_INK)
    at = np.arange(len(rgb))
    colours = rgb.clamp(0, 1).numpy()
    if alpha is not None:
        bars.bar(at, alpha.numpy(), 0.9, color=colours, alpha=0.35)
    bars.bar(
        at,
        weight.numpy(),
        0.9,
        color=colours,
        edgecolor=BETWEEN,
        linewidth=0.5,
    )
    if light is not None and len(light):
        bars.stairs(
            light.numpy(),
            np.arange(len(rgb) + 1) - 0.5,
            baseline=None,
            color=PALETTE[3],
            linewidth=1.5,
        )
    bars.set_ylim(0, 1.02)
    for axes, (name, strip) in zip(strip_axes, strips.items(), strict=True):
        axes.imshow(
            strip.clamp(0, 1).numpy()[None],
            aspect="auto",
            extent=(-0.5, len(rgb) - 0.5, 0, 1),
        )
        axes.set_ylabel(name, rotation=0, ha="right", va="center")
        axes.set_yticks([])
    for axes in (bars, *strip_axes):
        axes.set_xlim(-0.5, max(len(rgb), 1) - 0.5)
        axes.set_xticks([])
    return figure_picture(figure)


def lens_picture(
    image: AnyImage,
    splats: Splats,
    pixel: tuple[int, int],
    rows: Int[Tensor, " K"],
    *,
    radius_px: int = 12,
    size: int = 300,
) -> Picture:
    """The neighbourhood of a pixel, enlarged without smoothing, with the ellipses of some
    Gaussians.

    An ellipse is where its Gaussian has fallen to exp(-1/2): one standard deviation.

    Args:
        image: The rendered picture. [H, W, 3]
        splats: What it was rendered from.
        pixel: In the middle, framed. (column, row)
        rows: Gaussians to outline, the most important first, which gets a thicker line.
        radius_px: Pixels of the image to each side.
        size: Edge of the result, pixels.
    """
    figure, axes = lens_figure(image, pixel, radius_px, size)
    draw_ellipses(axes, splats, rows, INK)
    return figure_picture(figure)


def lens_figure(
    image: AnyImage, pixel: tuple[int, int], radius_px: int, size: int
) -> tuple["Figure", "Axes"]:
    """A square around a pixel, which is framed; ``image_figure`` with ``radius_px`` more pixels to
    each side."""
    from matplotlib.patches import Rectangle

    u, v = pixel
    r = radius_px
    figure, axes = image_figure(
        image,
        (size, size),
        (u - r, u + r + 1, v - r, v + r + 1),
    )
    axes.add_patch(
        Rectangle(
            pixel,
            1,
            1,
            fill=False,
            edgecolor=CROSS,
            linewidth=1.5,
            zorder=5,
        )
    )
    return figure, axes


def draw_ellipses(
    axes: "Axes",
    splats: Splats,
    rows: Int[Tensor, " K"],
    inks: Any,
) -> None:
    """Outlines of one standard deviation with a white seam, the first row's on top and thicker; one
    ink or one each."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patheffects import withStroke

    wide = [1.0] * (len(rows) - 1) + [2.0]
    axes.add_collection(
        PolyCollection(
            list(outlines(splats, rows)[::-1]),
            facecolors="none",
            edgecolors=inks if isinstance(inks, str) else inks[::-1],
            linewidths=wide,
            path_effects=[withStroke(linewidth=3, foreground="white")],
        )
    )


def outlines(
    splats: Splats, rows: Int[Tensor, " K"], points: int = 48
) -> Float[np.ndarray, "K points 2"]:
    """The one-standard-deviation ellipses of some rows as polygons, pixels."""
    return ellipse_outlines(splats.projection.uv[rows], splats.projection.conic[rows], points)


def ellipse_outlines(
    uv: Float[Tensor, "K 2"], conic: Float[Tensor, "K 3"], points: int = 48
) -> Float[np.ndarray, "K points 2"]:
    """Ellipses of one standard deviation as polygons, pixels: u + L (cos t, sin t) with L L^T = cov
    = conic^-1."""
    A, B, C = conic.double().unbind(-1)
    cov = torch.linalg.inv(torch.stack([A, B, B, C], -1).view(-1, 2, 2))
    t = torch.linspace(0, 2 * torch.pi, points + 1, dtype=torch.float64)[:-1]
    ring = torch.linalg.cholesky(cov) @ torch.stack([t.cos(), t.sin()])
    return (uv.double()[:, :, None] + ring).mT.numpy()


def with_cross(image: AnyImage, u: int, v: int, height: int) -> Picture:
    """The picture resized to ``height`` pixels, with a small cross around pixel (u, v)."""
    zoom = height / image.shape[0]
    return draw_cross(
        resize_to_height(image, height),
        ((u + 0.5) * zoom, (v + 0.5) * zoom),
    )


def draw_cross(picture: Picture, at: tuple[float, float]) -> Picture:
    """A copy of the picture with a small cross around a point (u, v), pixels, open in the
    middle."""
    image = picture.copy()
    x = round(at[0] - 0.5)
    y = round(at[1] - 0.5)
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        inner, outer = ((x + r * dx, y + r * dy) for r in (4, 12))
        cv2.line(image, inner, outer, (0, 0, 0), 4)
        cv2.line(image, inner, outer, (255, 210, 0), 2)
    return image


def resize_to_height(image: AnyImage, height: int) -> Picture:
    """The picture at another height, pixels; enlarged pixels stay sharp squares."""
    picture = to_uint8(image)
    zoom = height / picture.shape[0]
    how = cv2.INTER_AREA if zoom < 1 else cv2.INTER_NEAREST
    return np.asarray(
        cv2.resize(picture, (round(picture.shape[1] * zoom), height), interpolation=how),
        np.uint8,
    )


def ellipse_picture(splats: Splats, height: int) -> Picture:
    """The ellipses of all Gaussians of a map in their own colours on dark grey, farthest first.

    Args:
        splats: The Gaussians on the screen.
        height: Of the picture, pixels.
    """
    p = splats.projection
    camera = splats.camera
    zoom = height / camera.height
    view = np.full(
        (height, round(camera.width * zoom), 3),
        32,
        np.uint8,
    )
    rows = p.visible.nonzero().squeeze(1)
    rows = rows[p.depth_m[rows].argsort(descending=True)]
    rings = (outlines(splats, rows, 20) * zoom * 16).round().clip(-1e6, 1e6).astype(np.int32)
    inks = to_uint8(splats.rgb[rows][None])[0].tolist()
    for ring, ink in zip(rings, inks, strict=True):
        cv2.polylines(view, [ring], True, ink, 1, cv2.LINE_AA, shift=4)
    return view
