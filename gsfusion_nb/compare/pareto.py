"""The Pareto front of cost and quality, and its figure; for the lab one plot for each scene and cost."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ..drawing.curves import GRID, INK, MUTED, PAPER

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
from collections.abc import Iterable

from .spec import RunResult
from .statistics import COLUMNS, FIRST_METRIC, Group, group_runs

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Box = tuple[float, float, float, float]
"""Left, bottom, right, top, pixels."""

CHARACTER_PX, LINE_PX = 6.4, 14.0
"""Size of a character at 8 points and 100 dots per inch."""
_N_DIRECTIONS = 16
_NEAR_PX = 16.0
"""A name that is nearer to its point needs no line between them."""
_DISTANCES_PX = (3.0, 14.0, 28.0, 46.0, 66.0, 90.0, 118.0, 150.0, 190.0)

ON_FRONT, BEATEN = "#d1495b", "#3d85c6"
_LEAST_SPAN = 0.06
"""Half the width of a linear axis, relative to the largest cost: differences within a budget's tolerance look small."""
LARGEST_AREA, LEAST_AREA, PLAIN_AREA = 420.0, 40.0, 46.0
"""Areas of the points of the plot, points squared: of the slowest candidate, the smallest area used, and where the area
means nothing."""


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
    ms: np.ndarray | None = None
    """Time per frame, ms: areas of the points are proportional to it. [N]"""
    title: str = ""
    cost_label: str = "Gaussians (fewer is better)"
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
    """Quality over cost, with error bars, the front as a red line, and a name beside each rule.

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
    all_axes = [figure.add_subplot(rows, columns, i + 1) for i in range(len(plots))]
    for axes, points in zip(all_axes, plots, strict=True):
        _draw(axes, points)
    figure.draw_without_rendering()  # labels are placed in pixels, after the layout is known
    figure.set_layout_engine("none")
    for axes, points in zip(all_axes, plots, strict=True):
        _label_points(axes, points)
    return figure


def _draw(axes: "Axes", points: ParetoPoints) -> None:
    _style(axes, points)
    cost, quality = np.asarray(points.cost, float), np.asarray(points.quality, float)
    if len(points.names) == 0:
        axes.set(xticks=[], yticks=[])
        axes.text(0.5, 0.5, "no rule has finished yet", ha="center", va="center", color=MUTED)
        return
    on_front = pareto_front(cost, quality)
    colours = np.where(on_front, ON_FRONT, BEATEN)
    for name in dict.fromkeys(points.names):
        own = [i for i, other in enumerate(points.names) if other == name]
        own.sort(key=lambda i: cost[i])
        if len(own) > 1:
            axes.plot(cost[own], quality[own], color=MUTED, linewidth=0.8, alpha=0.5, zorder=1)
    _error_bars(axes, points, colours)
    axes.scatter(cost, quality, s=_areas(points), c=colours, alpha=0.75, edgecolors=PAPER, zorder=3)
    best = np.argsort(cost[on_front], kind="stable")
    axes.step(cost[on_front][best], quality[on_front][best], where="post", color=ON_FRONT, linewidth=1.2, zorder=2)
    axes.margins(x=0.38, y=0.25)
    _scale_of_costs(axes, cost)


def _style(axes: "Axes", points: ParetoPoints) -> None:
    axes.set_xlabel(points.cost_label, color=MUTED)
    axes.set_ylabel(points.quality_label, color=MUTED)
    axes.tick_params(colors=MUTED)
    axes.grid(True, which="major", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_color(GRID)
    meaning = "red: on the Pareto front" + ("; larger: more ms per frame" if points.ms is not None else "")
    axes.set_title(f"{points.title}\n{meaning}".strip(), fontsize=9, color=MUTED, loc="left")


def _areas(points: ParetoPoints) -> np.ndarray:
    if points.ms is None:
        return np.full(len(points.names), PLAIN_AREA)
    return np.maximum(LARGEST_AREA * points.ms / max(float(np.max(points.ms)), 1e-9), LEAST_AREA)


def _spread(sd: np.ndarray | None, n: int) -> np.ndarray:
    return np.zeros(n) if sd is None else np.nan_to_num(np.asarray(sd, float), nan=0.0)


def _ends(points: ParetoPoints) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the error bars, left, right and bottom, top; the left end stays on the logarithmic axis. [2, N] each"""
    n, cost, quality = len(points.names), np.asarray(points.cost, float), np.asarray(points.quality, float)
    wide, high = _spread(points.cost_sd, n), _spread(points.quality_sd, n)
    left = np.maximum(cost - wide, cost / 10)
    return np.stack([left, cost + wide]), np.stack([quality - high, quality + high])


def _error_bars(axes: "Axes", points: ParetoPoints, colours: np.ndarray) -> None:
    (left, right), (bottom, top) = _ends(points)
    style = {"colors": colours, "linewidth": 1.3, "alpha": 0.8, "zorder": 2}
    axes.hlines(points.quality, left, right, **style)
    axes.vlines(points.cost, bottom, top, **style)


def _label_points(axes: "Axes", points: ParetoPoints) -> None:
    """The name of each rule beside its best point, where it covers no point, error bar or other name if possible."""
    if len(points.names) == 0:
        return
    quality, area = np.asarray(points.quality, float), _areas(points)
    where = np.stack([np.asarray(points.cost, float), quality], axis=1)
    centre = axes.transData.transform(where).tolist()
    dots = [(x - r, y - r, x + r, y + r) for (x, y), r in zip(centre, (np.sqrt(area) * 0.7).tolist(), strict=True)]
    taken = [*dots, *_bar_boxes(axes, points)]
    left, bottom, right, top = np.asarray(axes.get_window_extent().extents).tolist()
    named: set[str] = set()
    order: list[int] = np.argsort(-quality, kind="stable").tolist()
    for i in order:
        if points.names[i] in named:
            continue
        named.add(points.names[i])
        x, y = centre[i]
        box = _free_place(dots[i], CHARACTER_PX * len(points.names[i]), taken, (left, bottom, right, top))
        taken.append(box)
        middle = ((box[0] + box[2]) / 2 - x) * 0.72, ((box[1] + box[3]) / 2 - y) * 0.72  # pixels to points
        near = box[0] - dots[i][2] < _NEAR_PX and dots[i][0] - box[2] < _NEAR_PX and abs(middle[1]) < _NEAR_PX
        line = None if near else {"arrowstyle": "-", "color": MUTED, "linewidth": 0.6}
        axes.annotate(
            points.names[i], (where[i, 0], where[i, 1]), xytext=middle, textcoords="offset points",
            ha="center", va="center", fontsize=8, color=INK, arrowprops=line,
            bbox={"boxstyle": "square,pad=0.05", "facecolor": PAPER, "edgecolor": "none", "alpha": 0.75},
        )  # fmt: skip


def _bar_boxes(axes: "Axes", points: ParetoPoints) -> list[Box]:
    """The error bars as boxes, pixels."""
    (left, right), (bottom, top) = _ends(points)
    quality, cost = np.asarray(points.quality, float), np.asarray(points.cost, float)
    corners = [np.stack(ends, axis=1) for ends in ((left, quality), (right, quality), (cost, bottom), (cost, top))]
    a, b, c, d = (axes.transData.transform(ends).tolist() for ends in corners)
    across = [(p[0], p[1] - 1, q[0], p[1] + 1) for p, q in zip(a, b, strict=True)]
    return across + [(p[0] - 1, p[1], p[0] + 1, q[1]) for p, q in zip(c, d, strict=True)]


def _free_place(dot: Box, width: float, taken: Sequence[Box], inside: Box) -> Box:
    """The nearest box beside ``dot`` that is inside the plot and covers nothing, or else covers least."""
    turns = [(math.cos(a), math.sin(a)) for a in np.linspace(0.5, 2.5, _N_DIRECTIONS + 1)[:-1] * np.pi]
    tried = np.array(
        [_place(dot, (width, LINE_PX), turn, far) for far, turn in itertools.product(_DISTANCES_PX, turns)]
    )
    fits = (tried[:, :2] > inside[:2]).all(axis=1) & (tried[:, 2:] < inside[2:]).all(axis=1)
    tried = tried[fits] if fits.any() else tried
    left, bottom, right, top = tried[np.argmin(_covered(tried, np.array(taken)))].tolist()
    return left, bottom, right, top


def _place(dot: Box, size: tuple[float, float], turn: tuple[float, float], far: float) -> Box:
    """A box of ``size`` beside ``dot``, in direction ``turn``, about ``far`` pixels from it."""
    reach = (dot[2] - dot[0]) / 2 + far
    x = (dot[0] + dot[2]) / 2 + turn[0] * (reach + size[0] / 2)
    y = (dot[1] + dot[3]) / 2 + turn[1] * (reach + size[1] / 2)
    return x - size[0] / 2, y - size[1] / 2, x + size[0] / 2, y + size[1] / 2


def _covered(boxes: Float[np.ndarray, "N 4"], taken: Float[np.ndarray, "M 4"]) -> Float[np.ndarray, "N"]:
    """How much of ``taken`` each box covers, pixels squared."""
    low = np.maximum(boxes[:, None, :2], taken[:, :2])
    high = np.minimum(boxes[:, None, 2:], taken[:, 2:])
    return np.maximum(high - low, 0.0).prod(axis=2).sum(axis=1)


def _scale_of_costs(axes: "Axes", cost: np.ndarray) -> None:
    """A logarithmic axis with 2k, 5k, 10k; a linear one if the costs are within a factor of two."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

    if cost.max() < 2 * cost.min():
        low, high = axes.get_xlim()
        middle, half = (low + high) / 2, max((high - low) / 2, _LEAST_SPAN * cost.max())
        axes.set_xlim(middle - half, middle + half)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:,.6g}"))
        return
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(base=10, subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v / 1000:g}k" if v >= 1000 else f"{v:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


COSTS = {
    "n_gaussians": "Gaussians (fewer is better)",
    "ms_per_frame": "time per frame, ms (less is better)",
    "n_steps": "gradient steps (fewer is better)",
}
"""Costs of the Pareto figure and their labels."""


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
        title=groups[0].scene,
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
    nothing = ParetoPoints(names=[], cost=np.zeros(0), quality=np.zeros(0))
    return pareto_figure(*(plots or [nothing]), columns=len(costs))
