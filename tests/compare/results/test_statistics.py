"""Means, spreads and ranks, by hand."""

import math

import pytest

from gsfusion_nb.compare import Budget
from gsfusion_nb.compare.statistics import group_runs, standings, summarise


def test_mean_and_spread():
    summary = summarise([2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0, math.nan])
    assert (summary.mean, summary.n) == (5.0, 8)
    assert summary.sd == pytest.approx(math.sqrt(32 / 7))
    one = summarise([3.0])
    none = summarise([math.nan])
    assert (one.mean, one.n, none.n) == (3.0, 1, 0)
    assert all(
        map(
            math.isnan,
            (one.sd, none.mean, summarise([math.inf, 3.0]).sd),
        )
    )


def test_a_group_is_a_rule_on_a_scene_at_a_budget_over_seeds(made_run, made_runs):
    found = [*made_runs("a", {"room": (20.0, 21.0, 22.0), "kitchen": (24.0,)}), made_run("b")]
    found += [made_run("a", budget=Budget(gaussians=99)), made_run("a", seed=3, failed="no memory")]
    groups = group_runs(found)
    assert [(g.label, g.scene, g.fixes_size) for g in groups] == [
        ("a", "room", False),
        ("a", "kitchen", False),
        ("b", "room", False),
        ("a", "room", True),
    ]
    assert (len(groups[0].runs), groups[0].failed[0].reason) == (3, "no memory")
    assert groups[0].summary("psnr_held_out_db").mean == 21.0


def test_the_order_is_that_of_the_mean_and_ranks_have_ties(made_run, made_runs):
    psnr = {"a": (25.0, 20.0), "b": (24.001, 21.0), "c": (24.004, 19.0)}
    found = [
        run
        for label, (x, y) in psnr.items()
        for run in made_runs(label, {"room": (x,), "kitchen": (y,)})
    ]
    found += [made_run("d", "room", psnr=30.0), made_run("e", failed="no memory")]
    order = standings(group_runs(found))
    assert [s.label for s in order] == ["b", "a", "c", "d", "e"]  # d has a result on one scene only
    assert [s.rank for s in order[:2]] == [2.25, 2.0]  # 3.5 and 1; 2 and 2
    assert math.isnan(order[3].rank)
