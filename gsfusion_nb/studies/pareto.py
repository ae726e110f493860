"""Which of many candidates are worth having when two things count, and a picture of it."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LARGEST_AREA, LEAST_AREA = 420.0, 40.0
"""Points squared: the slowest candidate, and the least that can still be seen."""


def pareto_front(cost: np.ndarray, quality: np.ndarray) -> np.ndarray:
    """Candidates that no other beats: none is at least as good in both and better in one.

    Args:
        cost: Less is better. [N]
        quality: More is better. [N]

    Returns:
        Whether each is on the front. [N] bool; of two alike both are.
    """
    cost, quality = np.asarray(cost, float), np.asarray(quality, float)
    as_good = (cost[:, None] <= cost) & (quality[:, None] >= quality)
    better = (cost[:, None] < cost) | (quality[:, None] > quality)
    return np.logical_not((as_good & better).any(axis=0))


def pareto_figure(names: Sequence[str], cost: np.ndarray, quality: np.ndarray, ms: np.ndarray) -> "Figure":
    """PSNR over the number of Gaussians, a point for each name, with the front as a line.

    Args:
        names: One per point.
        cost: Gaussians. [N]
        quality: PSNR, dB. [N]
        ms: ms per frame, which the points' areas are proportional to. [N]
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
        return figure
    on_front = pareto_front(cost, quality)
    area = np.maximum(LARGEST_AREA * ms / max(float(np.max(ms)), 1e-9), LEAST_AREA)
    colours = np.where(on_front, "#d1495b", "#3d85c6")
    axes.scatter(cost, quality, s=area, c=colours, alpha=0.75, edgecolors="white", zorder=3)
    best = np.argsort(cost[on_front], kind="stable")
    axes.step(cost[on_front][best], quality[on_front][best], where="post", color="#d1495b", linewidth=1.2, zorder=2)
    _labels(axes, names, cost, quality, area)
    axes.set_xscale("log")
    axes.margins(x=0.25, y=0.2)
    _plain_numbers(axes)
    axes.set_title("red: on the Pareto front; larger: more ms per frame", fontsize=9, color="#5c6675", loc="left")
    return figure


def _labels(axes, names: Sequence[str], cost: np.ndarray, quality: np.ndarray, area: np.ndarray) -> None:
    """A name at each point; above and below in turn, from left to right, where neighbours would overlap."""
    order = np.argsort(cost, kind="stable")
    for turn, i in enumerate(order):
        rise = np.sqrt(area[i]) / 2 + 4
        up = turn % 2 == 0
        axes.annotate(
            names[i], (cost[i], quality[i]), xytext=(0, rise if up else -rise), textcoords="offset points",
            ha="center", va="bottom" if up else "top", fontsize=8,
        )  # fmt: skip


def _plain_numbers(axes) -> None:
    """3k, 10k, 30k along the logarithmic axis."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.xaxis.set_major_locator(LogLocator(base=10, subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v / 1000:g}k" if v >= 1000 else f"{v:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
