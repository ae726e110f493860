"""Pareto front: by hand, against the definition in a loop, and equals; and its figure."""

from typing import Any

import numpy as np

from gsfusion_nb.compare.pareto import ParetoPoints, pareto_figure, pareto_front


def test_by_hand():
    front = pareto_front(np.array([1, 5, 9, 5]), np.array([20.0, 25.0, 24.0, 22.0]))
    assert front.tolist() == [True, True, False, False]


def test_equals_are_both_on_it_and_nothing_is_fine():
    assert pareto_front(np.array([3, 3]), np.array([2.0, 2.0])).tolist() == [True, True]
    assert pareto_front(np.array([]), np.array([])).shape == (0,)


def test_the_definition_in_a_loop():
    g = np.random.default_rng(0)
    cost, quality = g.integers(0, 8, 40), g.integers(0, 8, 40).astype(float)
    for i, on_front in enumerate(pareto_front(cost, quality)):
        beaten = any(
            cost[j] <= cost[i] and quality[j] >= quality[i] and (cost[j] < cost[i] or quality[j] > quality[i])
            for j in range(40)
        )
        assert on_front == (not beaten)


def points(names, cost, quality, **more):
    return ParetoPoints(names=names, cost=np.array(cost, float), quality=np.array(quality, float), **more)


def test_the_figure_names_everyone():
    figure = pareto_figure(points(["a", "b"], [1000, 2000], [20.0, 19.0]))
    assert [t.get_text() for t in figure.axes[0].texts] == ["a", "b"]


def test_a_rule_at_several_budgets_is_named_once_and_joined():
    plot = points(["a", "a", "b", "a"], [4000, 1000, 2000, 2000], [24.0, 20.0, 21.0, 22.0])
    axes = pareto_figure(plot).axes[0]
    assert [t.get_text() for t in axes.texts] == ["a", "b"]
    assert [1000, 2000, 4000] in [np.asarray(line.get_xdata()).tolist() for line in axes.lines]


def test_error_bars_stay_on_a_logarithmic_axis():
    wide = points(["a", "b"], [10, 1000], [1.0, 2.0], cost_sd=np.array([50.0, np.nan]))
    across: Any = pareto_figure(wide).axes[0].collections[0]
    assert across.get_segments()[0].tolist() == [[1, 1], [60, 1]]


def test_costs_that_are_close_have_a_linear_axis():
    figure = pareto_figure(points(["a", "b"], [3950, 4050], [20.0, 19.0]), points(["a", "b"], [1e3, 1e4], [2.0, 1.0]))
    assert [axes.get_xscale() for axes in figure.axes] == ["linear", "log"]
    assert len(pareto_figure(*[points([], [], [], title=str(i)) for i in range(3)]).axes) == 3
