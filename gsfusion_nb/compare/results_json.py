"""The numbers of the tables in their stored units, without rounding, as plain values."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from .equal_maps import EqualMaps, equal_maps
from .paired_tests import Comparison
from .rank_test import RankTest, rank_test
from .run_result import RunResult
from .scene_units import scene_units
from .statistics import COLUMNS, Group, Standing, Summary, over_units, standings, summarise


def budget_json(
    runs: Sequence[RunResult],
    groups: Sequence[Group],
    comparisons: Sequence[Comparison],
    *,
    tests: str,
    reference: str,
) -> dict[str, Any]:
    """The rows and tests of one budget.

    Args:
        runs: All runs of the comparison.
        groups: Those of the budget.
        comparisons: Of two rules at the budget.
        tests: What is tested: a name in ``TESTS``.
        reference: Label of the rule that all others are tested against.
    """
    budget = groups[0].budget
    units = scene_units(runs)
    tests_of = {
        test.a: test
        for test in (comparison.towards(reference) for comparison in comparisons)
        if test.b == reference
    }
    scenes = list(dict.fromkeys(group.scene for group in groups))
    unit_scenes: dict[str, list[str]] = {}
    for scene in scenes:
        unit_scenes.setdefault(units[scene], []).append(scene)
    pairs = [{"a": c.a, "b": c.b} | _test_json(c) for c in comparisons]
    return {
        "budget": budget,
        "scenes": scenes,
        "units": list(unit_scenes.values()),
        "tests": tests,
        "reference": reference,
        "rows": [
            _row(standing, groups, units, tests_of.get(standing.label))
            for standing in standings(groups, units)
        ],
        "pairs": pairs if tests == "pairs" else [],
        "ranks": _ranks_json(rank_test(runs, budget)) if tests == "nemenyi" else None,
        "equal_maps": [_equal_json(e) for e in equal_maps(runs) if e.budget == budget],
    }


def _row(
    standing: Standing,
    groups: Sequence[Group],
    units: Mapping[str, str],
    test: Comparison | None,
) -> dict[str, Any]:
    """One rule: its numbers over the scenes and on each."""
    own_groups = {group.scene: group for group in groups if group.label == standing.label}
    means = {
        metric: {
            scene: summary.mean
            for scene, group in own_groups.items()
            if (summary := group.summary(metric)).n
        }
        for metric in COLUMNS
    }
    return {
        "rule": standing.label,
        "rank": _number(standing.rank),
        "metrics": {
            metric: _summary(summarise(over_units(by_scene, units)))
            for metric, by_scene in means.items()
            if by_scene
        },
        "scenes": {
            scene: {
                metric: _summary(summary)
                for metric in COLUMNS
                if (summary := group.summary(metric)).n
            }
            for scene, group in own_groups.items()
        },
        "failed": {
            scene: group.failed[0].reason for scene, group in own_groups.items() if group.failed
        },
        "test": None if test is None else _test_json(test),
    }


def _test_json(test: Comparison) -> dict[str, Any]:
    return {
        "difference": _number(test.mean),
        "interval": [_number(v) for v in test.interval],
        "p": _number(test.p),
        "p_corrected": _number(test.corrected),
        "n": len(test.units),
        "verdict": test.verdict,
    }


def _ranks_json(test: RankTest) -> dict[str, Any]:
    pairs = [
        {"a": a, "b": b, "p": p, "better": (a, b) in test.better}
        for (a, b), p in test.pairs.items()
    ]
    ranks = dict(zip(test.labels, test.ranks, strict=True))
    values = {"p": _number(test.p), "n": test.n_units, "mean_ranks": ranks}
    return values | {"left_out": list(test.left_out), "pairs": pairs}


def _equal_json(equal: EqualMaps) -> dict[str, Any]:
    places = [{"scene": scene, "seed": seed} for scene, seed in equal.places]
    return {"rules": list(equal.labels), "places": places}


def _summary(summary: Summary) -> dict[str, Any]:
    return {"mean": _number(summary.mean), "sd": _number(summary.sd), "n": summary.n}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
