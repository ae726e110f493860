"""Reaching a budget: scratch runs that find the option of a rule, or the steps per frame. They are never scored."""

import dataclasses
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from typing import Any

from ..config import SystemConfig
from ..seeding import rule_name
from .find_value import NotReachedError, Search
from .map_scene import Entry, Mapped, budgeted, map_scene
from .rule_variants import observed
from .schedule import steps_per_frame, with_steps_per_frame, without_steps
from .size_options import SizeOption, size_option, start_value, with_size
from .spec import RunSpec

TUNING_SEED = 1_000_003
"""Seed of tuning runs, so that tuning never sees the random numbers of a scored run."""
MOST_STEPS = 10_000
"""Largest number of gradient steps per frame that is tried."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ready:
    """A run whose budget was tuned."""

    entry: Entry
    """With the tuned option."""
    config: SystemConfig
    """Settings of the mapper."""
    tuned: dict[str, Any] = field(default_factory=dict)
    """What was found, for ``RunResult.tuned``."""


def is_tuned(spec: RunSpec) -> bool:
    """Whether the budget of ``spec`` asks for tuning."""
    return spec.budget.gaussians is not None or spec.budget.seconds is not None


def tuning_spec(spec: RunSpec) -> RunSpec:
    """The run whose tuning is also that of ``spec``: equal but for the seed, which is the same for all."""
    return dataclasses.replace(spec, seed=TUNING_SEED)


def tune(entry: Entry) -> Generator[None, None, dict[str, Any]]:
    """Find what the budget of ``entry`` asks for, with scratch runs; yields between their frames.

    Returns:
        Plain values: option, value, n_gaussians (in the last tuning run), steps_per_frame, seconds, n_runs.

    Raises:
        NotReachedError: the budget cannot be reached. ValueError: the rule has no size option.
    """
    budget, found, runs = entry.spec.budget, {}, 0
    config = budgeted(entry.spec)
    if budget.gaussians is not None:
        found = yield from _tune_size(entry, config)
        entry = apply_size(entry, found)
        runs = found["n_runs"]
    if budget.seconds is not None:
        steps = yield from _tune_seconds(entry, budgeted(entry.spec))
        found = {**found, **steps, "n_runs": runs + steps["n_runs"]}
    return found


def reach_budget(entry: Entry, tuned: Mapping[str, Any] | None = None) -> Generator[None, None, Ready]:
    """The run as its budget wants it.

    Args:
        entry: The run.
        tuned: What ``tune`` found for ``tuning_spec(entry.spec)``; it is tuned here if None.
    """
    if not is_tuned(entry.spec):
        return Ready(entry=entry, config=budgeted(entry.spec))
    if tuned is None:
        tuned = yield from tune(dataclasses.replace(entry, spec=tuning_spec(entry.spec)))
    entry = apply_size(entry, tuned)
    config = budgeted(entry.spec)
    if "steps_per_frame" in tuned:
        config = with_steps_per_frame(config, tuned["steps_per_frame"])
    return Ready(entry=entry, config=config, tuned=dict(tuned))


def apply_size(entry: Entry, tuned: Mapping[str, Any]) -> Entry:
    """``entry`` with the tuned value of its size option."""
    if "option" not in tuned:
        return entry
    option = size_option(entry.spec, entry.found_rule())
    return dataclasses.replace(entry, spec=with_size(entry.spec, option, tuned["value"]))


def _tune_size(entry: Entry, config: SystemConfig) -> Generator[None, None, dict[str, Any]]:
    """First without gradient steps, which is fast; then, if they can change the number of Gaussians, with all of them.

    They cannot if the rule never read the Gaussians of the map and does not edit it.
    """
    spec, rule = entry.spec, entry.found_rule()
    option = size_option(spec, rule)
    start, target = start_value(spec, rule, option), spec.budget.gaussians
    assert target is not None
    whole = isinstance(start, int)
    tolerance, used = spec.budget.tolerance / 2, set()
    entry = dataclasses.replace(entry, rule=observed(rule, used))
    value, runs = float(start), 0
    for settings in (without_steps, None):
        search = Search(
            target=target, start=value, low=option.low, high=option.high, whole=whole, tolerance=tolerance,
            accepted=spec.budget.tolerance,
        )  # fmt: skip
        while (tried := search.next_value()) is not None:
            mapped = yield from _scratch_run(entry, option, int(tried) if whole else tried, settings)
            search.tell(tried, len(mapped.run.mapper.gaussians))
            if settings is without_steps and _steps_matter(config, used):
                search.tolerance = 4 * tolerance  # a start for the search with all steps
        value, runs = search.best, runs + len(search.counts)
        if not _steps_matter(config, used):
            break
    try:
        value = search.found()
    except NotReachedError as e:
        raise NotReachedError(
            f"{rule_name(rule)} does not reach {target:,} Gaussians within {spec.budget.tolerance:.1%} by its "
            f"option {option.name}: {e}"
        ) from None
    return {
        "option": option.name, "value": int(value) if whole else value, "n_runs": runs,
        "n_gaussians": int(search.counts[value]),
    }  # fmt: skip


def _steps_matter(config: SystemConfig, used: set[str]) -> bool:
    """Whether gradient steps can change how many Gaussians a rule makes that used these parts of the map."""
    return bool(used) and without_steps(config) != config


def _scratch_run(
    entry: Entry, option: SizeOption, value: float | int, settings: Callable[[SystemConfig], SystemConfig] | None
) -> Generator[None, None, Mapped]:
    changed = dataclasses.replace(entry, spec=with_size(entry.spec, option, value))
    config = budgeted(changed.spec)
    return (yield from _quiet(changed, settings(config) if settings else config))


def _tune_seconds(entry: Entry, config: SystemConfig) -> Generator[None, None, dict[str, Any]]:
    budget = entry.spec.budget
    assert budget.seconds is not None
    search = Search(
        target=budget.seconds,
        start=max(steps_per_frame(config), 1),
        low=1,
        high=MOST_STEPS,
        whole=True,
        tolerance=budget.tolerance / 2,
        accepted=budget.tolerance,
    )
    while (steps := search.next_value()) is not None:
        mapped = yield from _quiet(entry, with_steps_per_frame(config, int(steps)))
        search.tell(steps, mapped.seconds)
    try:
        found = search.found()
    except NotReachedError as e:
        raise NotReachedError(
            f"{budget.seconds:g} s within {budget.tolerance:.1%} cannot be reached by gradient steps per frame: {e} s"
        ) from None
    return {"steps_per_frame": int(found), "seconds": search.counts[found], "n_runs": len(search.counts)}


def _quiet(entry: Entry, config: SystemConfig) -> Generator[None, None, Mapped]:
    """``map_scene`` without its reports, which belong to the scored run."""
    steps = map_scene(entry, config, with_memory=False)
    while True:
        try:
            next(steps)
        except StopIteration as ended:
            return ended.value
        yield None
