"""Graphs as matplotlib figures without pyplot, safe in threads."""

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from . import pictures

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Numbers = Sequence[float | int] | np.ndarray

INK = "#1c2430"
MUTED = "#5c6675"
GRID = "#dfe4ea"
PAPER = "#fffffe"
"""White, behind names and around points; the colour of a card in a page."""
PALETTE = ("#3d85c6", "#e08a2e", "#1d743b", "#ff3061", "#7d43d5", "#aaaaaa", "#22b7d5", "#846409")
"""Blue, orange, green, red, violet, grey, turquoise, olive: visible on white and on a card. Each is
unlike the others, also to eyes that lack the cones for red, green or blue."""

STROKES = (
    "-",
    (0, (4, 2)),
    (0, (1.2, 1.4)),
    (0, (5, 1.4, 1.2, 1.4)),
    (0, (8, 2)),
    (0, (2.4, 2.4)),
    (0, (5, 1.4, 1.2, 1.4, 1.2, 1.4)),
    (0, (1.2, 3)),
)
"""Strokes and gaps of the curves of a graph, in widths of the line: they tell curves apart without
any colour, and a curve is seen through the gaps of another that lies on it."""

LEGEND_LETTERS = 78
"""Letters that fit into the width of a ``curve_figure``."""
SAMPLE_LETTERS = 7
"""Width of a line in a legend, and of the space behind its name, in letters."""

BETWEEN = "#{:02x}{:02x}{:02x}".format(*pictures.BETWEEN)
"""``pictures.BETWEEN`` as matplotlib and pages write it."""
CARD, CARD_INK = ("#{:02x}{:02x}{:02x}".format(*rgb) for rgb in (pictures.CARD, pictures.CARD_INK))
"""Ground and text of pictures in a row, as matplotlib writes them."""


def rgb_of(colour: str) -> tuple[int, ...]:
    """The bytes of "#rrggbb"."""
    return tuple(int(colour[i : i + 2], 16) for i in (1, 3, 5))


def curve_figure(
    x: Numbers,
    series: Mapping[str, Numbers],
    *,
    x_label: str,
    y_label: str,
    stacked: bool = False,
    marks: Numbers = (),
    marks_label: str = "",
    logarithmic: bool = False,
) -> "Figure":
    """A graph of one or more curves over a common axis; NaN leaves a gap. The first curve is drawn
    through, each other one has strokes of its own.

    Args:
        x: Positions, for example frame numbers.
        series: Label -> values, one per position.
        x_label: Axis label with its unit.
        y_label: Axis label with its unit.
        stacked: Stacked areas (parts of a whole) instead of lines.
        marks: Positions of ticks along the bottom, for example keyframes.
        marks_label: Meaning of the ticks, for the legend.
        logarithmic: Both axes are logarithmic, so that a power of x is a straight line. All values
            are above 0.

    Returns:
        A ``matplotlib.figure.Figure`` with an Agg canvas, 5.2 x 3 inches at 100 dpi.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    figure = Figure(figsize=(5.2, 3.0), dpi=100, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    _style(axes, x_label, y_label)
    if stacked:
        axes.stackplot(
            x,
            *series.values(),
            labels=list(series),
            colors=PALETTE,
            linewidth=0,
            alpha=0.9,
        )
        axes.set_ylim(bottom=0)
    else:
        for i, (label, values) in enumerate(series.items()):
            axes.plot(
                x,
                values,
                label=label,
                color=PALETTE[i % len(PALETTE)],
                linewidth=1.6,
                linestyle=STROKES[i % len(STROKES)],
                marker="o",
                markersize=3 if len(x) > 1 else None,
                markevery=_lone(values),
            )
    axes.margins(x=0.01)
    if logarithmic:
        axes.set_xscale("log")
        axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_formatter(NullFormatter())
    if len(marks):
        axes.margins(y=0.1)  # keeps the curve above the ticks
        axes.plot(
            marks,
            [0.02] * len(marks),
            transform=axes.get_xaxis_transform(),
            linestyle="none",
            marker="|",
            markersize=7,
            markeredgewidth=1.0,
            color=MUTED,
            label=marks_label,
            clip_on=False,
        )
    if len(series) + bool(len(marks)) > 1:
        legend: Any = figure.legend(
            loc="outside upper left",
            ncols=_legend_columns([*series, *([marks_label] if len(marks) else [])]),
            frameon=False,
            fontsize=9.5,
            labelcolor=INK,
            handlelength=2.4,
            columnspacing=1.2,
            borderpad=0.1,
        )
        legend.set_in_layout(True)
        for sample in legend.legend_handles:
            if len(x) > 1 and not stacked and sample.get_marker() == "o":
                sample.set_marker("")  # it would hide the gaps of the strokes
    return figure


def _lone(values: Numbers) -> list[int]:
    """Positions of the values beside which there is none, so that no line goes through them."""
    gaps = np.pad(np.isnan(np.asarray(values, float)), 1, constant_values=True)
    return np.flatnonzero(~gaps[1:-1] & gaps[:-2] & gaps[2:]).tolist()


def _legend_columns(labels: Sequence[str]) -> int:
    """How many names fit beside each other above a ``curve_figure``, at most 3."""
    longest = max(map(len, labels))
    return max(1, min(3, int(LEGEND_LETTERS / (longest + SAMPLE_LETTERS))))


def figure_png(figure) -> bytes:
    """PNG bytes of a matplotlib figure on a transparent ground, with text that is readable on white
    and on black."""
    from matplotlib.colors import to_hex
    from matplotlib.lines import Line2D
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        if to_hex(text.get_color()) in (INK, MUTED, "#000000"):
            text.set_color(BETWEEN)
    for line in figure.findobj(Line2D):
        if to_hex(line.get_color()) == GRID:
            line.set(color=BETWEEN, alpha=0.35)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", transparent=True)
    return buffer.getvalue()


def figure_words(figure: "Figure") -> str:
    """What a graph shows, in one sentence: its axes and the names of its curves."""
    parts = []
    for axes in figure.axes:
        names = [name for name in axes.get_legend_handles_labels()[1] if name]
        curves = f": {', '.join(names)}" if names else ""
        parts.append(
            f"{axes.get_ylabel() or 'values'} over {axes.get_xlabel() or 'positions'}{curves}"
        )
    return f"Graph of {'; '.join(parts)}"


def figure_picture(figure: "Figure", channels: int = 3) -> Any:
    """A figure as an image, at its own size and resolution; with 4 channels its ground stays
    transparent."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :channels].copy()


def style(
    axes: "Axes",
    *,
    x: str = "",
    y: str = "",
    title: str = "",
    ink: str = BETWEEN,
) -> None:
    """Labels and frame of a graph, readable on a light and on a dark page."""
    axes.set_facecolor("none")
    axes.set_xlabel(x, color=ink, fontsize=8)
    axes.set_ylabel(y, color=ink, fontsize=8)
    axes.set_title(title, color=ink, fontsize=8.5, loc="left", pad=3)
    axes.tick_params(colors=ink, labelsize=7.5, length=2.5)
    for spine in axes.spines.values():
        spine.set_color(ink)
        spine.set_linewidth(0.6)


def card_figure(
    width: int, height: int, rows: int = 1, **options: Any
) -> tuple["Figure", list[Any]]:
    """A figure on the ground of pictures in a row, and its axes below each other; for
    ``figure_picture``.

    Args:
        width, height: Of the picture, pixels.
        rows: Number of axes.
        options: Of ``Figure.subplots``.
    """
    from matplotlib.figure import Figure

    figure = Figure(
        figsize=(width / 100, height / 100), dpi=100, facecolor=CARD, layout="constrained"
    )
    axes = figure.subplots(rows, squeeze=False, **options)[:, 0]
    for one in axes:
        style(one, ink=CARD_INK)
    return figure, list(axes)


def image_figure(
    image: pictures.AnyImage,
    size: tuple[int, int],
    window: Sequence[float | int] = (),
) -> tuple["Figure", "Axes"]:
    """An image, enlarged without smoothing, to draw over in its pixels (u, v); for
    ``figure_picture``.

    Args:
        image: RGB. [H, W, 3]
        size: Width and height of the picture, pixels.
        window: What is shown, as u from and to, v from and to; light grey beyond the image. By
            default the whole image.
    """
    from matplotlib.figure import Figure

    figure = Figure(
        figsize=(size[0] / 100, size[1] / 100),
        dpi=100,
        facecolor="#ececec",
    )
    axes = figure.add_axes((0, 0, 1, 1))
    height, width = image.shape[:2]
    axes.imshow(
        pictures.to_uint8(image),
        extent=(0, width, height, 0),
        interpolation="nearest",
    )
    u0, u1, v0, v1 = window or (0, width, 0, height)
    axes.set(
        xlim=(u0, u1),
        ylim=(v1, v0),
        aspect="auto",
        autoscale_on=False,
    )
    axes.set_axis_off()
    return figure, axes


def _style(axes: "Axes", x_label: str, y_label: str) -> None:
    axes.set_xlabel(x_label, color=MUTED, fontsize=10)
    axes.set_ylabel(y_label, color=MUTED, fontsize=10)
    axes.tick_params(colors=MUTED, labelsize=9.5, length=3)
    axes.grid(axis="y", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.yaxis.set_major_formatter(_thousands)
    axes.locator_params(axis="y", nbins=6)
    axes.locator_params(axis="x", integer=True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(GRID)


def _thousands(value: float, _position: Any = None) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:g}"
