"""Paired tests: by hand, against scipy, and what they say with too little data."""

import math
import re
from typing import Any

import numpy as np
import pytest

from gsfusion_nb.lab import Budget
from gsfusion_nb.lab.paired_tests import bootstrap_interval, compare, holm, paired_t, signed_rank_p


def runs(make, label, psnr, scene="room", **more):
    return [make(label, scene, seed, db, **more) for seed, db in enumerate(psnr)]


def test_the_t_test_by_hand():
    # mean 2, sd 1, n 3: t = 2 sqrt(3); with 2 degrees of freedom, p = 1 - t / sqrt(t^2 + 2)
    (low, high), p = paired_t(np.array([1.0, 2.0, 3.0]))
    t = 2 * math.sqrt(3)
    assert p == pytest.approx(1 - t / math.sqrt(t * t + 2))
    quantile = 0.95 * math.sqrt(2 / (1 - 0.95**2))  # of 97.5 %, from the same closed form
    assert (low, high) == pytest.approx((2 - quantile / math.sqrt(3), 2 + quantile / math.sqrt(3)))


@pytest.mark.parametrize("n", [2, 5, 9, 30])
def test_the_t_test_is_scipys(n):
    from scipy import stats  # it takes a second to import

    d = np.random.default_rng(n).normal(0.3, 1.0, n)
    expected: Any = stats.ttest_1samp(d, 0.0)
    (low, high), p = paired_t(d)
    assert p == pytest.approx(expected.pvalue)
    assert (low, high) == pytest.approx(tuple(expected.confidence_interval()))


@pytest.mark.parametrize("n", [3, 8, 12, 40])
def test_the_signed_rank_test_is_scipys(n):
    from scipy import stats

    d = np.random.default_rng(n).normal(0.3, 1.0, n)
    method = "exact" if n <= 16 else "approx"
    expected: Any = stats.wilcoxon(d, method=method, correction=n > 16)
    assert signed_rank_p(d) == pytest.approx(expected.pvalue)


def test_the_signed_rank_test_by_hand_with_ties_and_zeros():
    assert signed_rank_p(np.array([1.0, 2.0, 3.0])) == 2 / 8
    assert signed_rank_p(np.array([0.0, 1.0, 1.0])) == 2 / 4
    # ranks 1.5, 1.5 and 3; the sums of the 8 patterns are 6, 3, 3, 0, 0, -3, -3, -6; the one found is 3
    assert signed_rank_p(np.array([-1.0, 1.0, 2.0])) == 6 / 8
    assert signed_rank_p(np.zeros(4)) == 1.0
    assert math.isnan(signed_rank_p(np.zeros(0)))


def test_degenerate_differences():
    assert paired_t(np.array([0.5, 0.5, 0.5])) == ((0.5, 0.5), 0.0)
    assert paired_t(np.zeros(3)) == ((0.0, 0.0), 1.0)
    assert math.isnan(paired_t(np.array([1.0]))[1])


def test_the_bootstrap_covers_the_mean_and_repeats():
    d = np.random.default_rng(3).normal(1.0, 0.2, 25)
    low, high = bootstrap_interval(d)
    (t_low, t_high), _ = paired_t(d)
    assert (low, high) == pytest.approx((t_low, t_high), abs=0.02)
    assert bootstrap_interval(d) == (low, high)
    assert math.isnan(bootstrap_interval(d[:1])[0])


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, math.nan]) == pytest.approx([0.03, 0.06, 0.06, math.nan], nan_ok=True)
    assert holm([0.5, 0.6]) == [1.0, 1.0]


def test_a_clear_difference_a_small_one_and_none(made_run):
    a = runs(made_run, "a", [25.0, 25.1, 24.9]) + runs(made_run, "a", [20.0, 20.1, 19.9], "kitchen")
    b = runs(made_run, "b", [24.0, 24.2, 23.9]) + runs(made_run, "b", [19.1, 19.0, 18.9], "kitchen")
    c = runs(made_run, "c", [25.2, 24.9, 25.0]) + runs(made_run, "c", [20.0, 20.1, 19.8], "kitchen")
    clear = compare(a + b, "b", "a")
    assert clear.verdict == "b"
    assert clear.mean == pytest.approx(-np.mean([1.0, 0.9, 1.0, 0.9, 1.1, 1.0]))
    assert str(clear).startswith("a is better than b by 0.98 dB PSNR, which is more than noise (95 % interval")
    assert "6 pairs of runs on 2 scenes" in str(clear)
    assert str(clear) == str(compare(a + b, "a", "b"))
    assert re.search(r"95 % interval 0\.\d\d to 1\.\d\d dB", str(clear))
    assert compare(a + c, "a", "c").verdict == "noise"
    assert "within noise" in str(compare(a + c, "a", "c"))
    same = runs(made_run, "d", [25.0, 25.1, 24.9])
    assert str(compare(a + same, "a", "d")) == "a and d have the same PSNR in all 3 pairs of runs on 1 scene"


def test_rules_that_win_on_different_scenes_are_not_called_noise_only(made_run):
    a = runs(made_run, "a", [25.0, 25.1, 24.9]) + runs(made_run, "a", [20.0, 20.1, 19.9], "kitchen")
    b = runs(made_run, "b", [24.0, 24.2, 23.8]) + runs(made_run, "b", [21.0, 21.2, 20.8], "kitchen")
    comparison = compare(a + b, "a", "b")
    assert comparison.verdict == "noise"
    assert comparison.opposite_scenes == (["room"], ["kitchen"])
    assert str(comparison).endswith("; but a is better on room, and b on kitchen")


def test_with_one_seed_nothing_can_be_said(made_run):
    one = [made_run(label, scene, 0, db) for scene in ("room", "kitchen") for label, db in (("a", 25.0), ("b", 20.0))]
    comparison = compare(one, "a", "b")
    assert comparison.verdict == "unknown"
    assert "nothing can be said about noise" in str(comparison)
    with pytest.raises(KeyError, match="no runs of 'z'; there are: a, b"):
        compare(one, "a", "z")
    with pytest.raises(KeyError, match="no runs of 'z'; there are none"):
        compare([], "z", "a")


def test_a_rule_without_a_completed_run_has_its_reason(made_run):
    a = runs(made_run, "a", [25.0, 25.1, 24.9])
    b = [made_run("b", failed="no memory"), made_run("b", failed="no disk", seed=1)]
    text = "a and b: nothing can be said about noise, because all runs of b failed: no memory"
    assert str(compare(a + b, "a", "b")) == text
    assert "use at least three seeds" in str(compare([*a, *b, made_run("b", seed=2)], "a", "b"))


def test_pairs_have_scene_seed_and_budget_in_common(made_run):
    small, large = Budget(gaussians=10), Budget(gaussians=20)
    a = runs(made_run, "a", [25.0, 25.0], budget=small) + runs(made_run, "a", [30.0, 31.0], budget=large)
    b = [*runs(made_run, "b", [24.0, 23.0], budget=small), made_run("b", failed="no memory", budget=large)]
    assert compare(a + b, "a", "b").differences == {"room": [1.0, 2.0]}
    assert compare(a + b, "a", "b", budget=str(large)).n == 0
    assert "all runs of b failed: no memory" in str(compare(a + b, "a", "b", budget=str(large)))
    assert "no pair" in str(compare([a[0], b[1]], "a", "b"))


def test_the_better_direction_is_that_of_the_metric(made_run):
    a, b = (
        [made_run(label, seed=s, depth_l1_held_out_m=m + 0.0001 * s) for s in range(3)]
        for label, m in (("a", 0.01), ("b", 0.03))
    )
    comparison = compare(a + b, "a", "b", metric="depth_l1_held_out_m")
    assert comparison.verdict == "a"
    assert "by 2.00 cm" in str(comparison)
