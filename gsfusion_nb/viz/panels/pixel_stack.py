"""Which Gaussians made a pixel, as numbers and as a drawing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from markupsafe import Markup
from torch import Tensor

from ...drawing.curves import BETWEEN, CARD_INK, PALETTE, card_figure, figure_picture, style
from ...drawing.page import html_table
from ...drawing.pictures import Picture
from .pixel_blend import Blend, Splats, blend_at, check_pixel

TABLE_ROWS = 14
"""Gaussians in a table; of the others their number is given."""


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
    if blend is None:
        blend = blend_at(splats, splats.projection.uv.new_tensor([[u + 0.5, v + 0.5]]))
    return PixelStack(
        u=u,
        v=v,
        row=blend.row,
        depth_m=splats.projection.depth_m[blend.row],
        alpha=blend.alpha[0],
        weight=blend.weight[0],
        transmittance=blend.transmittance[0, :-1],
        rgb=splats.rgb[blend.row],
        light_left=float(blend.transmittance[0, -1]),
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
