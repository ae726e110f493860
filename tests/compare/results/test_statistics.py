"""Means, ranks, and paired tests whose units are the scenes: by hand, and what they say with too little data."""

import dataclasses
import math

import pytest

from gsfusion_nb.compare import Budget
from gsfusion_nb.compare.scene_units import scene_units, shared_frames
from gsfusion_nb.compare.statistics import (
    against_reference,
    compare,
    corrected,
    group_runs,
    paired_test,
    standings,
    summarise,
)


def runs(make, label, by_scene, **more):
    """Runs of a rule from scene -> a number for each seed."""
    return [make(label, scene, seed, db, **more) for scene, of in by_scene.items() for seed, db in enumerate(of)]


def test_mean_and_spread():
    summary = summarise([2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0, math.nan])
    assert (summary.mean, summary.n) == (5.0, 8)
    assert summary.sd == pytest.approx(math.sqrt(32 / 7))
    one, none = summarise([3.0]), summarise([math.nan])
    assert (one.mean, one.n, none.n) == (3.0, 1, 0)
    assert all(map(math.isnan, (one.sd, none.mean, summarise([math.inf, 3.0]).sd)))


def test_a_group_is_a_rule_on_a_scene_at_a_budget_over_seeds(made_run):
    found = [*runs(made_run, "a", {"room": (20.0, 21.0, 22.0), "kitchen": (24.0,)}), made_run("b")]
    found += [made_run("a", budget=Budget(gaussians=99)), made_run("a", seed=3, failed="no memory")]
    groups = group_runs(found)
    assert [(g.label, g.scene, g.fixes_size) for g in groups] == [
        ("a", "room", False), ("a", "kitchen", False), ("b", "room", False), ("a", "room", True)
    ]  # fmt: skip
    assert (len(groups[0].runs), groups[0].failed[0].reason) == (3, "no memory")
    assert groups[0].summary("psnr_held_out_db").mean == 21.0


def test_the_order_is_that_of_the_mean_and_ranks_have_ties(made_run):
    psnr = {"a": (25.0, 20.0), "b": (24.001, 21.0), "c": (24.004, 19.0)}
    found = [run for label, (x, y) in psnr.items() for run in runs(made_run, label, {"room": (x,), "kitchen": (y,)})]
    found += [made_run("d", "room", psnr=30.0), made_run("e", failed="no memory")]
    order = standings(group_runs(found))
    assert [s.label for s in order] == ["b", "a", "c", "d", "e"]  # d has a result on one scene only
    assert [s.rank for s in order[:2]] == [2.25, 2.0]  # 3.5 and 1; 2 and 2
    assert math.isnan(order[3].rank)


def test_the_tests_by_hand():
    # mean 2, sd 1, n 3: t = 2 sqrt(3); with 2 degrees of freedom, p = 1 - t / sqrt(t^2 + 2)
    (low, high), p = paired_test([1.0, 2.0, 3.0])
    t, quantile = 2 * math.sqrt(3), 0.95 * math.sqrt(2 / (1 - 0.95**2))
    assert p == pytest.approx(1 - t / math.sqrt(t * t + 2))
    assert (low, high) == pytest.approx((2 - quantile / math.sqrt(3), 2 + quantile / math.sqrt(3)))
    (low, high), p = paired_test([0.5] * 3)
    assert (low, high, p) == pytest.approx((0.5, 0.5, 0.0))
    assert paired_test([0.0] * 3) == ((0.0, 0.0), 1.0)
    assert math.isnan(paired_test([1.0])[1])


def test_p_values_are_corrected_by_holms_method(made_run):
    base = compare([made_run("a"), made_run("b")], "a", "b")
    found = corrected([dataclasses.replace(base, p=p) for p in (0.01, 0.04, 0.03, math.nan)])
    assert [c.corrected for c in found] == pytest.approx([0.03, 0.06, 0.06, math.nan], nan_ok=True)
    assert {c.n_tests for c in found} == {3}


def test_more_seeds_make_no_scene(made_run):
    """On every scene the seeds leave no doubt; over the scenes there is doubt, however many seeds there are."""
    lead = {"room": 1.5, "kitchen": 0.1, "hall": 0.9}
    found = []
    for seed in range(20):
        for scene, d in lead.items():
            found += [made_run("a", scene, seed, 20 + d + 1e-3 * (seed % 3)), made_run("b", scene, seed, 20.0)]
    over_all = compare(found, "a", "b")
    assert (len(over_all.units), over_all.verdict) == (3, "noise")
    assert over_all.p == pytest.approx(paired_test(list(lead.values()))[1], rel=0.01)
    assert "60 pairs of runs on 3 scenes" in str(over_all)
    on_one = compare([r for r in found if r.spec.scene == "kitchen"], "b", "a")
    assert (len(on_one.units), on_one.verdict) == (20, "b")
    assert str(on_one).startswith("a is better than b by 0.10 dB PSNR held out, which is more than noise (95 %")


def test_better_is_said_only_where_it_holds_after_the_correction(made_run):
    scenes = [f"scene {i}" for i in range(5)]
    found = runs(made_run, "best", dict.fromkeys(scenes, (25.0,)))
    found += runs(made_run, "near", {s: (24.5 + 0.4 * (i % 2) - 0.3 * (i == 4),) for i, s in enumerate(scenes)})
    alone = compare(found, "best", "near")
    assert alone.verdict == "a"
    for k in range(8):
        found += runs(made_run, f"other {k}", {s: (24.9 - 3.0 * (i == k % 5),) for i, s in enumerate(scenes)})
    found += runs(made_run, "bad", {s: (10.0 + 0.01 * i,) for i, s in enumerate(scenes)})
    tests = {t.b: t for t in against_reference(found, str(Budget()))}
    assert (tests["near"].a, tests["near"].p, tests["near"].verdict) == ("best", alone.p, "noise")
    assert "is better" not in str(tests["near"])
    assert "corrected for 10 comparisons" in str(tests["near"])
    assert tests["bad"].verdict == "a"
    own = against_reference(found, str(Budget()), "near")
    assert {t.a for t in own} == {"near"}
    assert next(t for t in own if t.b == "best").verdict == "noise"
    assert against_reference(found, str(Budget()), "nobody") == []


def test_too_little_data_says_so(made_run):
    one = [made_run(label, psnr=db) for label, db in (("a", 25.0), ("b", 20.0))]
    assert compare(one, "a", "b").verdict == "unknown"
    same = runs(made_run, "a", {"x": (1.0,), "y": (2.0,)}) + runs(made_run, "b", {"x": (1.0,), "y": (2.0,)})
    assert compare(same, "a", "b").verdict == "equal"
    with pytest.raises(KeyError, match="z"):
        compare(one, "a", "z")


def test_pairs_have_scene_seed_and_budget_in_common(made_run):
    small, large = Budget(gaussians=10), Budget(gaussians=20)
    a = runs(made_run, "a", {"x": (25.0, 25.0)}, budget=small) + runs(made_run, "a", {"x": (30.0, 31.0)}, budget=large)
    b = [*runs(made_run, "b", {"x": (24.0, 23.0)}, budget=small), made_run("b", failed="no memory", budget=large)]
    assert compare(a + b, "a", "b").differences == {"x": [1.0, 2.0]}
    assert compare(a + b, "a", "b", budget=str(large)).units == []


def test_the_better_direction_is_that_of_the_metric(made_run):
    a, b = (
        [made_run(label, scene, depth_l1_held_out_m=m + x) for scene, x in (("x", 0.0), ("y", 1e-4), ("z", 2e-4))]
        for label, m in (("a", 0.01), ("b", 0.03))
    )
    comparison = compare(a + b, "a", "b", metric="depth_l1_held_out_m")
    assert comparison.verdict == "a"
    assert "by 2.00 cm" in str(comparison)


def again(found, scene, label, frames):
    """The runs on one scene once more, under another name of it, as runs with these frames."""
    return [
        dataclasses.replace(r, spec=dataclasses.replace(r.spec, scene=label), data_hash="", frames=frames)
        for r in found
        if r.spec.scene == scene
    ]


def test_one_recording_under_three_labels_is_one_scene(made_run):
    """It was "better by 1.92 dB, more than noise, p < 0.001", with each label as a scene."""
    found = runs(made_run, "a", {"kitchen": (22.0, 22.1)}) + runs(made_run, "b", {"kitchen": (20.0, 20.2)})
    thrice = [
        run for k in range(3) for run in again(found, "kitchen", f"kitchen {k}", [f"frame {k}", f"frame {k + 1}"])
    ]
    once = compare(found, "a", "b")
    test = compare(thrice, "a", "b")
    assert (len(test.units), test.p) == (2, once.p)  # two seeds of one scene
    assert "6 pairs of runs on 3 scenes, which share frames and count as 1;" in str(test)
    other = runs(made_run, "a", {"hall": (25.0, 25.0)}) + runs(made_run, "b", {"hall": (24.0, 24.0)})
    assert compare(thrice + other, "a", "b").units == pytest.approx([1.95, 1.0])
    order = standings(group_runs(thrice + other))
    assert [(s.label, s.over_scenes.n) for s in order] == [("a", 2), ("b", 2)]
    assert order[0].over_scenes.mean == pytest.approx((22.05 + 25.0) / 2)


def test_units_are_joined_through_a_third_scene(made_run):
    def of(scene, frames, data_hash=""):
        return dataclasses.replace(made_run("a", scene), frames=frames, data_hash=data_hash)

    chain = [of("x", ["1", "2"]), of("y", ["4"]), of("z", ["2", "3", "4"]), of("w", ["9"]), of("v", [])]
    assert scene_units(chain) == dict.fromkeys("xyz", "x + y + z") | {"w": "w", "v": "v"}
    assert scene_units([of("x", [], "same"), of("y", [], "same")]) == dict.fromkeys("xy", "x + y")
    assert shared_frames(scene_units(chain)) == [
        "x, y and z share frames, so they count as one scene in means and tests"
    ]


def test_seeds_that_change_no_map_are_one_observation(made_run):
    """Two rules that draw nothing differ by the same number with every seed, which is no evidence."""
    found = runs(made_run, "a", {"room": (21.0,) * 5}) + runs(made_run, "b", {"room": (20.0,) * 5})
    found = [dataclasses.replace(r, map_hash=f"map of {r.spec.label}") for r in found]
    test = compare(found, "a", "b")
    assert test.verdict == "unknown"
    assert str(test) == (
        "a and b: nothing can be said about noise from 5 pairs of runs on 1 scene, in which the seeds made 1 different "
        "pair of maps; use several scenes"
    )
