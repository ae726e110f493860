"""Mean and spread over seeds, groups, and ranks over scenes, by hand."""

import math

import pytest

from gsfusion_nb.lab import Budget
from gsfusion_nb.lab.statistics import group_runs, rank_rules, summarise


def test_the_standard_deviation_is_that_of_a_sample():
    summary = summarise([2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0])
    assert summary.mean == 5.0
    assert summary.sd == pytest.approx(math.sqrt(32 / 7))
    assert summary.n == 8


def test_one_value_has_no_spread_and_no_value_has_no_mean():
    one, none = summarise([3.0, math.nan]), summarise([math.nan])
    assert (one.mean, one.n) == (3.0, 1)
    assert math.isnan(one.sd)
    assert math.isnan(none.mean)
    assert none.n == 0
    assert math.isnan(summarise([math.inf, 3.0]).sd)


def test_a_group_is_a_rule_on_a_scene_at_a_budget_over_seeds(made_run):
    runs = [made_run("a", seed=s, psnr=20.0 + s) for s in range(3)]
    runs += [made_run("a", scene="kitchen"), made_run("a", budget=Budget(gaussians=99)), made_run("b")]
    runs.append(made_run("a", seed=3, failed="no memory"))
    groups = group_runs(runs)
    assert [(g.label, g.scene, g.budget) for g in groups] == [
        ("a", "room", "own size, equal steps"), ("a", "kitchen", "own size, equal steps"),
        ("a", "room", "99 Gaussians, equal steps"), ("b", "room", "own size, equal steps"),
    ]  # fmt: skip
    assert len(groups[0].runs) == 3
    assert [r.reason for r in groups[0].failed] == ["no memory"]
    assert groups[0].summary("psnr_held_out_db").mean == 21.0
    assert groups[0].summary("lpips_held_out").n == 0


def test_ranks_over_scenes_with_ties_and_a_missing_rule(made_run):
    psnr = {"room": {"a": 25.0, "b": 24.0, "c": 24.0}, "kitchen": {"a": 20.0, "b": 21.0, "c": 19.0}}
    runs = [made_run(label, scene, psnr=db) for scene, of in psnr.items() for label, db in of.items()]
    ranks = rank_rules(group_runs([*runs, made_run("d", "room", psnr=23.0)]))
    assert ranks["a"].by_scene == {"room": 1.0, "kitchen": 2.0}
    assert ranks["b"].by_scene == {"room": 2.5, "kitchen": 1.0}
    assert ranks["c"].mean == 2.75
    assert math.isnan(ranks["d"].mean)
    assert list(ranks) == ["a", "b", "c", "d"]


def test_equal_in_the_digits_of_the_table_is_a_tie_and_lower_can_be_better(made_run):
    runs = [made_run("a", psnr=24.001, ms_per_frame=9.0), made_run("b", psnr=24.004, ms_per_frame=3.0)]
    groups = group_runs(runs)
    assert [rank.mean for rank in rank_rules(groups).values()] == [1.5, 1.5]
    assert list(rank_rules(groups, metric="ms_per_frame")) == ["b", "a"]


def test_what_cannot_be_ranked(made_run):
    groups = group_runs([made_run("a"), made_run("b", budget=Budget(gaussians=99))])
    with pytest.raises(ValueError, match="one budget"):
        rank_rules(groups)
    with pytest.raises(ValueError, match="n_steps"):
        rank_rules(groups[:1], metric="n_steps")
