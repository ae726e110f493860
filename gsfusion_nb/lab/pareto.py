"""The Pareto front of cost and quality, and its figure."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Box = tuple[float, float, float, float]
"""Left, bottom, right, top, pixels."""

CHARACTER_PX, LINE_PX = 6.4, 14.0
"""Size of a character at 8 points and 100 dots per inch."""
_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, 1), (1, -1), (-1, -1))
_DISTANCES_PX = (3.0, 14.0, 28.0, 46.0, 66.0)

LARGEST_AREA, LEAST_AREA = 420.0, 40.0
"""Areas of the points of the plot, points squared: of the slowest candidate, and the smallest area used."""


def pareto_front(cost: np.ndarray, quality: np.ndarray) -> np.ndarray:
    """The candidates that no other beats, that is, none is at least as good in both numbers and better in one.

    Args:
        cost: Less is better. [N]
        quality: More is better. [N]

    Returns:
        Whether each candidate is on the front; two equal ones both are. [N] bool
    """
    cost, quality = np.asarray(cost, float), np.asarray(quality, float)
    as_good = (cost[:, None] <= cost) & (quality[:, None] >= quality)
    better = (cost[:, None] < cost) | (quality[:, None] > quality)
    return np.logical_not((as_good & better).any(axis=0))


def pareto_figure(names: Sequence[str], cost: np.ndarray, quality: np.ndarray, ms: np.ndarray) -> "Figure":
    """PSNR over the number of Gaussians, one point per name, with the front as a line.

    Args:
        names: One per point.
        cost: Gaussians. [N]
        quality: PSNR, dB. [N]
        ms: Time per frame, ms; areas of the points are proportional to it. [N]
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.0), dpi=100, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_xlabel("Gaussians (fewer is better)")
    axes.set_ylabel("PSNR of held-out views, dB")
    axes.grid(True, which="major", alpha=0.3)
    if len(names) == 0:
        axes.set(xticks=[], yticks=[])
        axes.text(0.5, 0.5, "no rule has finished yet", ha="center", va="center", color="#5c6675")
        return figure
    on_front = pareto_front(cost, quality)
    area = np.maximum(LARGEST_AREA * ms / max(float(np.max(ms)), 1e-9), LEAST_AREA)
    colours = np.where(on_front, "#d1495b", "#3d85c6")
    axes.scatter(cost, quality, s=area, c=colours, alpha=0.75, edgecolors="white", zorder=3)
    best = np.argsort(cost[on_front], kind="stable")
    axes.step(cost[on_front][best], quality[on_front][best], where="post", color="#d1495b", linewidth=1.2, zorder=2)
    axes.set_xscale("log")
    axes.margins(x=0.38, y=0.25)
    _plain_numbers(axes)
    axes.set_title("red: on the Pareto front; larger: more ms per frame", fontsize=9, color="#5c6675", loc="left")
    _labels(axes, names, cost, quality, area)
    return figure


def _labels(axes, names: Sequence[str], cost: np.ndarray, quality: np.ndarray, area: np.ndarray) -> None:
    """A name beside each point, at the first position where it covers neither a point nor another name."""
    from matplotlib.patheffects import withStroke

    axes.figure.draw_without_rendering()
    centre = axes.transData.transform(np.stack([cost, quality], axis=1).astype(float)).tolist()
    dots = [(x - r, y - r, x + r, y + r) for (x, y), r in zip(centre, (np.sqrt(area) * 0.7).tolist(), strict=True)]
    taken = list(dots)
    for i in np.argsort(-quality, kind="stable"):
        x, y = centre[i]
        size = CHARACTER_PX * len(names[i]), LINE_PX
        places = [_place(dots[i], size, turn, far) for far in _DISTANCES_PX for turn in _DIRECTIONS]
        box = next((p for p in places if not any(_overlap(p, other) for other in taken)), places[0])
        taken.append(box)
        middle = ((box[0] + box[2]) / 2 - x) * 0.72, ((box[1] + box[3]) / 2 - y) * 0.72  # pixels to points
        axes.annotate(
            names[i], (cost[i], quality[i]), xytext=middle, textcoords="offset points", ha="center", va="center",
            fontsize=8, arrowprops={"arrowstyle": "-", "color": "#8a8f98", "linewidth": 0.6},
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )  # fmt: skip


def _place(dot: Box, size: tuple[float, float], turn: tuple[int, int], far: float) -> Box:
    """A box of ``size`` beside ``dot``, in direction ``turn``, ``far`` pixels from it."""
    x, y = (dot[0] + dot[2]) / 2, (dot[1] + dot[3]) / 2
    reach = (dot[2] - dot[0]) / 2 + far
    x += turn[0] * (reach + size[0] / 2)
    y += turn[1] * (reach + size[1] / 2)
    return x - size[0] / 2, y - size[1] / 2, x + size[0] / 2, y + size[1] / 2


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _plain_numbers(axes) -> None:
    """3k, 10k, 30k along the logarithmic axis."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.xaxis.set_major_locator(LogLocator(base=10, subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v / 1000:g}k" if v >= 1000 else f"{v:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
