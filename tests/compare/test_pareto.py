"""Pareto front: by hand, against the definition in a loop, and equals; and its figure."""

import itertools
from typing import Any

import numpy as np
import pytest

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
    figure = pareto_figure(points(["a", "b"], [1000, 2000], [20.0, 19.0], ms=np.array([3.0, 9.0])))
    assert [t.get_text() for t in figure.axes[0].texts] == ["a", "b"]


def test_a_rule_at_several_budgets_is_named_once_and_joined():
    plot = points(["a", "a", "b", "a"], [4000, 1000, 2000, 2000], [24.0, 20.0, 21.0, 22.0])
    axes = pareto_figure(plot).axes[0]
    assert [t.get_text() for t in axes.texts] == ["a", "b"]
    assert np.asarray(axes.lines[0].get_xdata()).tolist() == [1000, 2000, 4000]


def test_error_bars_in_both_directions():
    plot = points(
        ["a", "b"], [1000, 2000], [20.0, 19.0], cost_sd=np.array([100, np.nan]), quality_sd=np.array([0.5, 5e-2])
    )
    bars: Any = pareto_figure(plot).axes[0].collections
    across, up = bars[:2]
    assert [s.tolist() for s in across.get_segments()] == [[[900, 20], [1100, 20]], [[2000, 19], [2000, 19]]]
    assert up.get_segments()[0].tolist() == [[1000, 19.5], [1000, 20.5]]
    wide = points(["a"], [10], [1.0], cost_sd=np.array([50.0]))  # a logarithmic axis has no zero
    bars = pareto_figure(wide).axes[0].collections
    assert bars[0].get_segments()[0].tolist() == [[1, 1], [60, 1]]


@pytest.mark.parametrize("equal_budget", [False, True])
def test_names_cover_neither_points_nor_bars_nor_each_other(equal_budget):
    g = np.random.default_rng(2)
    names = [f"a rule with number {i}" for i in range(14)]
    cost = 4000 + g.normal(0, 50, 14) if equal_budget else 10 ** g.uniform(3, 4.5, 14)
    figure = pareto_figure(points(names, cost, g.uniform(18, 25, 14), quality_sd=np.full(14, 0.1)))
    axes = figure.axes[0]
    figure.draw_without_rendering()
    boxes = [t.get_window_extent() for t in axes.texts]
    for a, b in itertools.combinations(boxes, 2):
        assert not a.overlaps(b)
    for centre in axes.transData.transform(axes.collections[2].get_offsets()):
        assert not any(box.contains(*centre) for box in boxes)
    frame = axes.get_window_extent()
    assert all(frame.contains(box.x0, box.y0) and frame.contains(box.x1, box.y1) for box in boxes)


def test_costs_that_are_close_have_a_linear_axis_with_numbers():
    figure = pareto_figure(points(["a", "b"], [3950, 4050], [20.0, 19.0]), points(["a", "b"], [1e3, 1e4], [2.0, 1.0]))
    assert [axes.get_xscale() for axes in figure.axes] == ["linear", "log"]
    low, high = figure.axes[0].get_xlim()
    assert high - low >= 0.12 * 4050
    assert "4,000" in [t.get_text() for t in figure.axes[0].get_xticklabels()]


def test_several_plots_in_rows():
    figure = pareto_figure(*[points(["a"], [1], [1.0], title=str(i)) for i in range(3)])
    assert figure.get_size_inches().tolist() == [12.8, 8.0]
    assert len(figure.axes) == 3
