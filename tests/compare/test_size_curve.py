"""Quality against the number of Gaussians, and the short table, by hand."""

import dataclasses
from typing import Any

import pytest

from gsfusion_nb.compare import size_curve
from gsfusion_nb.compare.outputs import Results, Table
from gsfusion_nb.compare.run_result import RunResult
from gsfusion_nb.compare.spec import Budget, RunSpec
from gsfusion_nb.compare.tables import SHORT


def run(label: str, n: int, psnr_db: float, seed: int = 0, scene: str = "room") -> RunResult:
    spec = RunSpec(rule="uniform", label=label, scene=scene, seed=seed, budget=Budget(gaussians=n))
    metrics = {
        "psnr_held_out_db": psnr_db,
        "ssim_held_out": 0.7,
        "depth_l1_held_out_m": 0.021,
        "n_gaussians": float(n + 10),
        "ms_per_frame": 12.0,
    }
    return RunResult(spec=spec, status="done", metrics=metrics)


RUNS = [
    run("mine", 4000, 24.0),
    run("mine", 1000, 20.0),
    run("mine", 1000, 22.0, seed=1),
    run("theirs", 1000, 19.0),
    run("theirs", 4000, 25.0),
]


def test_a_curve_for_each_rule_through_its_budgets():
    axes = size_curve(RUNS).axes[0]
    containers: Any = axes.containers
    mine, theirs = (container.lines[0] for container in containers)
    assert mine.get_xdata().tolist() == [1010.0, 4010.0]
    assert mine.get_ydata().tolist() == [21.0, 24.0]
    assert theirs.get_ydata().tolist() == [19.0, 25.0]
    (bars,) = containers[0].lines[2]
    low, high = bars.get_segments()[0][:, 1]
    assert (low, high) == (pytest.approx(21 - 2**0.5), pytest.approx(21 + 2**0.5))
    assert axes.get_legend_handles_labels()[1] == ["mine", "theirs"]
    assert mine.get_marker() != theirs.get_marker()
    assert axes.get_ylabel() == "PSNR held out, dB"
    assert axes.get_xticks().tolist() == [1000, 4000]


def test_a_number_in_the_unit_of_the_tables():
    axes = size_curve(RUNS, "depth_l1_held_out_m").axes[0]
    containers: Any = axes.containers
    assert containers[0].lines[0].get_ydata().tolist() == [pytest.approx(2.1)] * 2
    assert axes.get_ylabel().endswith(", cm")


def test_what_cannot_be_drawn_is_refused():
    with pytest.raises(ValueError, match="expected runs of one scene, got desk, room"):
        size_curve([*RUNS, run("mine", 1000, 20.0, scene="desk")])
    with pytest.raises(ValueError, match="no run has finished"):
        size_curve([dataclasses.replace(RUNS[0], status="failed", metrics={})])
    with pytest.raises(KeyError, match="psnr_held_aut_db"):
        size_curve(RUNS, "psnr_held_aut_db")


def test_the_short_table_has_four_numbers_and_the_rest_is_behind_a_click():
    results = Results(runs=RUNS, about=Table(specs=[r.spec for r in RUNS]))
    table = results.tables()[0]
    assert [column.metric for column in table.short.columns] == list(SHORT)
    assert [column.metric for column in table.columns] == [*SHORT[:1], "ssim_held_out", *SHORT[1:]]
    assert [row.label for row in table.short.rows] == [row.label for row in table.rows]
    page = results._repr_html_()
    assert [column.metric for column in table.rest.columns] == ["ssim_held_out"]
    assert page.count("<details>") == 2
    assert page.count("1 more number") == 2
    assert page.index("<details>") < page.index("SSIM")
