"""Pareto front: by hand, against the definition in a loop, and equals."""

import numpy as np
from matplotlib.figure import Figure

from gsfusion_nb.compare.page import BEATEN, ON_FRONT, _draw, pareto_front
from gsfusion_nb.compare.run_result import RunResult
from gsfusion_nb.compare.spec import RunSpec
from gsfusion_nb.compare.statistics import group_runs


def test_by_hand():
    front = pareto_front(
        np.array([1, 5, 9, 5]),
        np.array([20.0, 25.0, 24.0, 22.0]),
    )
    assert front.tolist() == [True, True, False, False]


def test_equals_are_both_on_it_and_nothing_is_fine():
    assert pareto_front(np.array([3, 3]), np.array([2.0, 2.0])).tolist() == [True, True]
    assert pareto_front(np.array([]), np.array([])).shape == (0,)


def test_the_definition_in_a_loop():
    g = np.random.default_rng(0)
    cost = g.integers(0, 8, 40)
    quality = g.integers(0, 8, 40).astype(float)
    for i, on_front in enumerate(pareto_front(cost, quality)):
        beaten = any(
            cost[j] <= cost[i]
            and quality[j] >= quality[i]
            and (cost[j] < cost[i] or quality[j] > quality[i])
            for j in range(40)
        )
        assert on_front == (not beaten)


def test_every_rule_is_drawn_in_the_colour_of_its_place():
    """Small and good, large and better, large and worse."""
    runs = [
        RunResult(
            spec=RunSpec(rule="uniform", label=label),
            status="done",
            metrics={"psnr_held_out_db": quality, "n_gaussians": size},
        )
        for label, size, quality in (("a", 100.0, 20.0), ("b", 900.0, 25.0), ("c", 950.0, 19.0))
    ]
    axes = Figure().add_subplot()
    _draw(axes, group_runs(runs), "n_gaussians", "")
    drawn = {}
    for points, *_ in axes.containers:
        drawn[points.get_color()] = list(zip(*points.get_data(), strict=True))
    assert drawn == {ON_FRONT: [(100, 20.0), (900, 25.0)], BEATEN: [(950, 19.0)]}
