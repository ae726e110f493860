"""The Pareto front of cost and quality, and its figure: one plot for each scene and cost."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..drawing.curves import GRID, INK, MUTED, PAPER
from .spec import RunResult
from .statistics import COLUMNS, FIRST_METRIC, Group, group_runs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ON_FRONT, BEATEN = "#d1495b", "#3d85c6"
COSTS = {
    "n_gaussians": "Gaussians (fewer is better)",
    "ms_per_frame": "time per frame, ms (less is better)",
    "n_steps": "gradient steps (fewer is better)",
}
"""Costs of the Pareto figure and their labels."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ParetoPoints:
    """The points of one plot. Points of the same name are one rule at several budgets and are joined by a line."""

    names: Sequence[str]
    """[N]"""
    cost: np.ndarray
    """Less is better. [N]"""
    quality: np.ndarray
    """More is better. [N]"""
    cost_sd: np.ndarray | None = None
    """Half the length of the horizontal error bars; NaN for none. [N]"""
    quality_sd: np.ndarray | None = None
    """Half the length of the vertical error bars; NaN for none. [N]"""
    title: str = ""
    cost_label: str = COSTS["n_gaussians"]
    quality_label: str = "PSNR of held-out views, dB"


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


def pareto_figure(*plots: ParetoPoints, columns: int = 2) -> "Figure":
    """Quality over cost, with error bars, the front as a red line, and a name beside the best point of each rule.

    Args:
        plots: One or more; each is 6.4 x 4 inches at 100 dpi.
        columns: Plots in a row.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(columns, len(plots))
    rows = math.ceil(len(plots) / columns)
    figure = Figure(figsize=(6.4 * columns, 4.0 * rows), dpi=100, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    for i, points in enumerate(plots):
        _draw(figure.add_subplot(rows, columns, i + 1), points)
    return figure


def _draw(axes: "Axes", points: ParetoPoints) -> None:
    axes.set_xlabel(points.cost_label, color=MUTED)
    axes.set_ylabel(points.quality_label, color=MUTED)
    axes.tick_params(colors=MUTED)
    axes.grid(True, which="major", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.set_title(f"{points.title}\nred: on the Pareto front".strip(), fontsize=9, color=MUTED, loc="left")
    cost, quality = np.asarray(points.cost, float), np.asarray(points.quality, float)
    if len(points.names) == 0:
        axes.set(xticks=[], yticks=[])
        axes.text(0.5, 0.5, "no rule has finished yet", ha="center", va="center", color=MUTED)
        return
    none = np.zeros(len(cost))
    wide, high = (none if sd is None else np.nan_to_num(sd) for sd in (points.cost_sd, points.quality_sd))
    front = pareto_front(cost, quality)
    for chosen, colour in ((front, ON_FRONT), (~front, BEATEN)):
        left = np.minimum(wide, 0.9 * cost)  # a logarithmic axis has no zero
        axes.errorbar(cost[chosen], quality[chosen], xerr=(left[chosen], wide[chosen]), yerr=high[chosen],
                      fmt="o", color=colour, alpha=0.8, linewidth=1.3, zorder=3)  # fmt: skip
    best = np.argsort(cost[front], kind="stable")
    axes.step(cost[front][best], quality[front][best], where="post", color=ON_FRONT, linewidth=1.2, zorder=2)
    for name in dict.fromkeys(points.names):
        own = [i for i, other in enumerate(points.names) if other == name]
        own.sort(key=lambda i: cost[i])
        if len(own) > 1:
            axes.plot(cost[own], quality[own], color=MUTED, linewidth=0.8, alpha=0.5, zorder=1)
        i = max(own, key=lambda i: quality[i])
        axes.annotate(name, (float(cost[i]), float(quality[i])), xytext=(5, 4), textcoords="offset points", fontsize=8,
                      color=INK)  # fmt: skip
    axes.margins(x=0.2, y=0.15)
    _scale_of_costs(axes, cost)


def _scale_of_costs(axes: "Axes", cost: np.ndarray) -> None:
    """A logarithmic axis with 2k, 5k, 10k; a linear one if the costs are within a factor of two."""
    from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator, NullFormatter

    if cost.max() < 2 * cost.min():
        axes.xaxis.set_major_locator(MaxNLocator(5))
        return
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(base=10, subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_minor_formatter(NullFormatter())


def costs_of(groups: Sequence[Group]) -> list[str]:
    """The costs that are plotted: gradient steps only where the rules took different numbers of them; none where the
    budget gave all rules the same size or time."""
    steps = {group.summary("n_steps").mean for group in groups if group.summary("n_steps").n}
    costs = [cost for cost in COSTS if cost != "n_steps" or len(steps) > 1]
    return [] if groups and all(group.fixes_cost for group in groups) else costs


def scene_points(groups: Sequence[Group], cost: str, quality: str = FIRST_METRIC) -> ParetoPoints:
    """The rules of one scene as points with error bars; groups without a number are left out."""
    found = [(g, g.summary(cost), g.summary(quality)) for g in groups]
    found = [(g, c, q) for g, c, q in found if c.n and np.isfinite(q.mean) and c.mean > 0]
    column = COLUMNS[quality]
    return ParetoPoints(
        names=[g.label for g, _, _ in found],
        cost=np.array([c.mean for _, c, _ in found]),
        quality=np.array([q.mean for _, _, q in found]) * column.scale,
        cost_sd=np.array([c.sd for _, c, _ in found]),
        quality_sd=np.array([q.sd for _, _, q in found]) * column.scale,
        title=groups[0].scene if groups else "",
        cost_label=COSTS.get(cost, COLUMNS[cost].name),
        quality_label=column.name,
    )


def figure_of(results: Iterable[RunResult]) -> "Figure":
    """Held-out PSNR over each cost on each scene, of budgets that leave the cost to the rules; error bars: standard
    deviation over seeds."""
    groups = [group for group in group_runs(results) if not group.fixes_cost]
    costs = costs_of(groups)
    scenes = [[g for g in groups if g.scene == scene] for scene in dict.fromkeys(g.scene for g in groups)]
    plots = [scene_points(of_scene, cost) for of_scene in scenes for cost in costs]
    return pareto_figure(*(plots or [scene_points([], "n_gaussians")]), columns=max(len(costs), 1))
