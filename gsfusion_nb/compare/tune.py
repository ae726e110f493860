"""Reaching a budget: runs with a seed of their own, until the size option of a rule gives it."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping
from typing import Any

from ..config import SystemConfig
from ..seeding import rule_name
from .map_scene import Entry, OnStep, budgeted, map_scene
from .rule_variants import observed
from .schedule import without_steps
from .search import NotReachedError, Number, error_ratios, nearest, search
from .size_options import size_option, start_value, with_size
from .spec import RunSpec

TUNING_SEED = 1_000_003
"""Seed of tuning runs, so that tuning never sees the random numbers of a scored run."""
FAR_TOO_MANY = 4.0
"""A tuning run ends where its map has this many times the Gaussians that are wanted."""


def is_tuned(spec: RunSpec) -> bool:
    """Whether the budget of ``spec`` asks for tuning."""
    return spec.budget.gaussians is not None


def tuning_spec(spec: RunSpec) -> RunSpec:
    """The run whose tuning is also that of ``spec``: equal but for the seed, which is the same for
    all."""
    return dataclasses.replace(spec, seed=TUNING_SEED)


def with_tuned(entry: Entry, tuned: Mapping[str, Any] | None) -> Entry:
    """``entry`` with the tuned value of its size option, if something was tuned."""
    if tuned is None:
        return entry
    option = size_option(entry.spec, entry.found_rule())
    return dataclasses.replace(entry, spec=with_size(entry.spec, option, tuned["value"]))


def tune(entry: Entry, on_step: OnStep = lambda report: None) -> dict[str, Any]:
    """Find what the budget of ``entry`` asks for, with scratch runs; ``on_step`` is called between
    their frames.

    First without gradient steps, which is fast; then, if they can change the number of Gaussians,
    with all of them. They cannot if the rule never read the Gaussians of the map and does not edit
    it.

    Returns:
        Plain values: option, value, n_gaussians (in the last tuning run), n_runs.

    Raises:
        NotReachedError: the budget cannot be reached. ValueError: the rule has no size option.
    """
    spec = entry.spec
    rule = entry.found_rule()
    used = set()
    option = size_option(spec, rule)
    config = budgeted(spec)
    start = start_value(spec, rule, option)
    target = spec.budget.gaussians
    tolerance = spec.budget.tolerance
    assert target is not None
    whole = isinstance(start, int)
    has_steps = without_steps(config) != config
    entry = dataclasses.replace(entry, rule=observed(rule, used))
    limits: dict[str, Any] = {"low": option.low, "high": option.high, "whole": whole}

    def counter(settings: Callable[[SystemConfig], SystemConfig]) -> Callable[[Number], Number]:
        def count(value: Number) -> int:
            most = math.inf if "after_step" in used else FAR_TOO_MANY * target
            changed_entry = dataclasses.replace(
                entry, spec=with_size(spec, option, int(value) if whole else value)
            )
            return _count(changed_entry, settings(budgeted(changed_entry.spec)), most, on_step)

        return count

    count = counter(without_steps)
    first = min(max(float(start), option.low), option.high)
    first = round(first) if whole else first
    counts: dict[Number, Number] = {first: count(first)}  # which tells what the rule reads
    rough = 4 if used and has_steps else 1  # only a start for the search with all steps
    counts = search(
        count, target, start=first, tolerance=rough * tolerance / 2, counts=counts, **limits
    )
    value = min(counts, key=error_ratios(counts, target).__getitem__)
    n_runs = len(counts)
    # and seeding is most without steps
    too_few = "after_step" not in used and counts[value] < target / 2
    if used and has_steps and not too_few:
        counts = search(
            counter(lambda config: config), target, start=value, tolerance=tolerance / 2, **limits
        )
        n_runs += len(counts)
    try:
        value = nearest(counts, target, tolerance)
    except NotReachedError as e:
        raise NotReachedError(
            f"{rule_name(rule)} does not reach {target:,} Gaussians within {tolerance:.1%} by its "
            f"option {option.name}: {e}"
        ) from None
    return {
        "option": option.name,
        "value": int(value) if whole else value,
        "n_runs": n_runs,
        "n_gaussians": int(counts[value]),
    }


def _count(entry: Entry, config: SystemConfig, most: float, on_step: OnStep) -> int:
    """Gaussians in the map of a scratch run; extrapolated from a run that is given up, at more than
    ``most``."""
    steps = map_scene(entry, config, scratch=True)
    n_frames = len(entry.opened().mapping)
    for n_mapped in itertools.count(1):
        try:
            report = next(steps)
        except StopIteration as ended:
            return len(ended.value.run.mapper.gaussians)
        if report is not None and report.n_gaussians > most:
            return int(float(f"{report.n_gaussians * n_frames / n_mapped:.2g}"))
        on_step(None)
    raise AssertionError
