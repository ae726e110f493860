"""Quality against the number of Gaussians: one curve for each rule."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from ..checks import check_name
from ..drawing.curves import GRID, INK, MUTED, PAPER
from ..errors import ArgumentError
from .run_result import RunResult
from .statistics import COLUMNS, FIRST_METRIC, Group, group_runs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LINES = (
    ("#0072b2", "o"),
    ("#d55e00", "s"),
    ("#009e73", "^"),
    ("#cc79a7", "D"),
    ("#56b4e9", "v"),
    ("#e69f00", "P"),
    ("#000000", "X"),
)
"""Colour and marker of each curve: the colours of Okabe & Ito (2008), which people who see few
colours can tell apart, and the markers say the same."""


def size_curve(results: Iterable[RunResult], metric: str = FIRST_METRIC) -> "Figure":
    """Mean of a number over the mean number of Gaussians, a curve for each rule through its
    budgets; error bars: standard deviation over the seeds.

    Args:
        results: Runs of one scene.
        metric: Name of the number, of ``COLUMNS``; the held-out PSNR by default.

    Raises:
        ValueError: runs of several scenes, or none that has both numbers.
        KeyError: no such number.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, NullFormatter

    check_name("number", metric, COLUMNS)
    column = COLUMNS[metric]
    groups = [g for g in group_runs(results) if g.runs]
    scenes = {g.scene for g in groups}
    if len(scenes) > 1:
        raise ArgumentError(f"expected runs of one scene, got {', '.join(sorted(scenes))}")
    groups = [g for g in groups if g.summary(metric).n and g.summary("n_gaussians").n]
    if not groups:
        raise ArgumentError("no run has finished that could be drawn")
    figure = Figure(figsize=(6.4, 4.0), dpi=100, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for i, label in enumerate(dict.fromkeys(g.label for g in groups)):
        colour, marker = LINES[i % len(LINES)]
        sizes, values, spread = _points([g for g in groups if g.label == label], metric)
        scale = column.scale
        axes.errorbar(
            sizes,
            values * scale,
            yerr=spread * scale,
            color=colour,
            marker=marker,
            linewidth=1.6,
            markersize=6,
            capsize=3,
            label=label,
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda n, _: f"{n:,.0f}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    budgets = [run.spec.budget.gaussians for g in groups for run in g.runs]
    if fixed_sizes := sorted({n for n in budgets if n is not None}):
        axes.set_xticks(fixed_sizes)
    axes.set_xlabel("Gaussians", color=MUTED)
    axes.set_ylabel(column.name, color=MUTED)
    axes.tick_params(colors=MUTED)
    axes.grid(True, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.legend(frameon=False, labelcolor=INK)
    return figure


def _points(groups: list[Group], metric: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sizes in ascending order, and mean and standard deviation there, 0 with one seed."""
    rows = sorted(
        (g.summary("n_gaussians").mean, g.summary(metric).mean, g.summary(metric).sd)
        for g in groups
    )
    sizes, values, spread = np.array(rows, dtype=float).T
    return sizes, values, np.nan_to_num(spread)
