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


def test_no_name_covers_another_one_or_a_point():
    """Thirteen rules of chapter 9, some of which lie beside each other."""
    rules = {
        "dense": (116360, 22.46),
        "budget n_cells=3000": (18532, 22.16),
        "gsfusion": (13788, 21.90),
        "transparent": (12385, 21.68),
        "budget n_cells=1600": (9656, 21.43),
        "uniform fraction=0.2": (23274, 21.40),
        "uniform fraction=0.1": (11638, 20.63),
        "budget n_cells=800": (4777, 20.53),
        "budget test=alpha": (3972, 20.24),
        "uniform fraction=0.05": (5815, 19.98),
        "rtg_slam": (9029, 19.96),
        "uniform fraction=0.02": (2329, 19.14),
        "budget n_cells=300": (1798, 19.13),
    }
    runs = [
        RunResult(
            spec=RunSpec(rule="uniform", label=label),
            status="done",
            metrics={"psnr_held_out_db": quality, "n_gaussians": float(size)},
        )
        for label, (size, quality) in rules.items()
    ]
    figure = Figure(figsize=(6.4, 4.0), dpi=100)
    axes = figure.add_subplot()
    _draw(axes, group_runs(runs), "n_gaussians", "room")
    figure.draw_without_rendering()
    boxes = {text.get_text(): text.get_window_extent() for text in axes.texts}
    assert set(boxes) == set(rules)
    for name, box in boxes.items():
        assert not [other for other in boxes if other != name and box.overlaps(boxes[other])]
        points = axes.transData.transform(list(rules.values()))
        assert not any(box.contains(*point) for point in points), name


def test_ticks_of_a_cost_are_plain_numbers():
    runs = [
        RunResult(
            spec=RunSpec(rule="uniform", label=label),
            status="done",
            metrics={"psnr_held_out_db": quality, "ms_per_frame": ms},
        )
        for label, ms, quality in (("a", 27.5, 19.0), ("b", 93.0, 22.0))
    ]
    figure = Figure(figsize=(6.4, 4.0), dpi=100)
    axes = figure.add_subplot()
    _draw(axes, group_runs(runs), "ms_per_frame", "room")
    figure.draw_without_rendering()
    ticks = axes.xaxis.get_ticklabels(which="both")
    shown = {text.get_text() for text in ticks if text.get_text()}
    assert {"30", "50", "100"} <= shown
    assert all(text.replace(",", "").isdigit() for text in shown)
