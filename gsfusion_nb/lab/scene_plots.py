"""Pareto plots of the lab: quality over cost on each scene, with the spread over seeds as error bars."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from .columns import COLUMNS, FIRST_METRIC
from .pareto import ParetoPoints, pareto_figure
from .result import RunResult
from .statistics import Group, group_runs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COSTS = {
    "n_gaussians": "Gaussians (fewer is better)",
    "ms_per_frame": "time per frame, ms (less is better)",
    "n_steps": "gradient steps (fewer is better)",
}
"""Costs of the Pareto figure and their labels."""


def costs_of(groups: Sequence[Group]) -> list[str]:
    """The costs that are plotted: gradient steps only where the rules took different numbers of them."""
    steps = {group.summary("n_steps").mean for group in groups if group.summary("n_steps").n}
    return [cost for cost in COSTS if cost != "n_steps" or len(steps) > 1]


def scene_points(groups: Sequence[Group], cost: str, quality: str = FIRST_METRIC) -> ParetoPoints:
    """The rules of one scene, at all budgets, as points with error bars; groups without a number are left out."""
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
    """Held-out PSNR over each cost on each scene; error bars: standard deviation over seeds."""
    groups = group_runs(results)
    costs = costs_of(groups)
    scenes = [[g for g in groups if g.scene == scene] for scene in dict.fromkeys(g.scene for g in groups)]
    plots = [scene_points(of_scene, cost) for of_scene in scenes for cost in costs]
    nothing = ParetoPoints(names=[], cost=np.zeros(0), quality=np.zeros(0))
    return pareto_figure(*(plots or [nothing]), columns=len(costs))
