"""Pareto front: by hand, against the definition in a loop, and equals."""

import numpy as np

from gsfusion_nb.compare.page import pareto_front


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
