"""Reaching a budget: the option of a rule that decides its size, and the search for the value that
gives the budget."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from ..checks import shown
from ..config import SystemConfig
from ..errors import ArgumentError, ForeseenError
from ..seeding import SeedingRule, is_built_in, rule_name, rule_options
from .map_scene import Entry, OnStep, budgeted, map_scene, observed, original
from .schedule import dotted, flat_settings, without_steps
from .spec import RunSpec

THIN = "thin"
"""Size option of any rule: the share of its seeds that is kept, drawn at random."""


@dataclass(frozen=True)
class SizeOption:
    """A number that decides how many Gaussians a rule makes."""

    name: str
    """Option of the rule, a dotted setting, or "thin"."""
    low: float | int
    """Smallest value that is tried."""
    high: float | int
    """Largest value that is tried."""


_SHARE = SizeOption("share", 1e-5, 1.0)
_THRESHOLD = SizeOption("seeding.quadtree_threshold", 1e-6, 100.0)
SIZE_OPTIONS: dict[str, SizeOption] = {
    **dict.fromkeys(("gsfusion", "vg_mapping"), _THRESHOLD),
    "uniform": SizeOption("fraction", 1e-5, 1.0),
    **dict.fromkeys(("edge_discs", "edge_strokes"), SizeOption("spacing_px", 1.0, 200.0)),
    **dict.fromkeys(("monogs", "monogs_like"), SizeOption("density", 1e-4, 128.0)),
    "photo_slam": SizeOption("corners", 1, 100_000),
    "gs_icp": SizeOption("density", 1e-3, 100.0),
    "on_the_fly_nvs": SizeOption("density", 1e-4, 1e4),
    "cone_gs": SizeOption("share", 1e-5, 1e3),
    **dict.fromkeys(("default_strategy", "mcmc", "game"), _SHARE),
    **dict.fromkeys(
        ("cg_slam", "gaus_slam", "gaussian_slam", "gps_slam", "gs_slam", "hf_slam", "mm3dgs"),
        _SHARE,
    ),
    **dict.fromkeys(
        ("rtg_slam", "splatam", "splatam_like", "two_dgs_slam", "vings", "vtgaussian"), _SHARE
    ),
}
"""Registered rule -> its size option."""


def size_option(spec: RunSpec, rule: SeedingRule) -> SizeOption:
    """The size option of a run: the one that ``spec`` names, else the rule's own.

    Raises:
        ValueError: there is none, the rule does not have it, or it is not a number.
    """
    option = SIZE_OPTIONS.get(rule_name(rule)) if is_built_in(original(rule)) else None
    name = dotted(spec.size_option) or (option.name if option else "")
    if not name:
        raise ArgumentError(
            f"the rule {rule_name(rule)} has no size option: name the option that changes its "
            "number of Gaussians as "
            f'size_option (its options: {", ".join(rule_options(rule)) or "none"}), or "{THIN}", '
            "which keeps a random "
            f"share of its seeds"
        )
    if option is not None and name == option.name and spec.size_range is None:
        return option
    low, high = spec.size_range or _usual_range(spec, rule, name)
    return SizeOption(name, low, high)


def start_value(spec: RunSpec, rule: SeedingRule, option: SizeOption) -> float | int:
    """The value of the size option before it is tuned.

    Raises:
        ValueError: the rule and the settings do not have it, or it is not a number.
    """
    if option.name == THIN:
        return spec.keep_share
    values = {**flat_settings(spec.config()), **rule_options(rule), **spec.options}
    if option.name not in values:
        names = ", ".join([*rule_options(rule), THIN])
        raise ArgumentError(
            f"the rule {rule_name(rule)} has no option {shown(option.name)} to tune; known: {names}"
        )
    value = values[option.name]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or value <= 0:
        raise ArgumentError(
            f"the size option {option.name} must be a number above 0, got {shown(value)}"
        )
    return value


def with_size(spec: RunSpec, option: SizeOption, value: float | int) -> RunSpec:
    """``spec`` with another value of the size option; its label stays."""
    values = spec.to_json()
    if option.name == THIN:
        values["keep_share"] = value
    elif "." in option.name:
        values["settings"] = {**values["settings"], option.name: value}
    else:
        values["options"] = {**values["options"], option.name: value}
    return RunSpec.from_json(values)


def _usual_range(
    spec: RunSpec,
    rule: SeedingRule,
    name: str,
) -> tuple[float | int, float | int]:
    if name == THIN:
        return 1e-5, 1.0
    start = start_value(spec, rule, SizeOption(name, 0, 0))
    if isinstance(start, float) and start <= 1 and "." not in name:
        return 1e-5, 1.0
    return (1, 1000 * start) if isinstance(start, int) else (start / 1e4, start * 1e4)


MOST_RUNS = 24
"""Evaluations after which the search gives up."""
_FARTHEST = 8.0
"""Largest factor between the value of one evaluation and the next."""
_CLOSEST = 1e-3
"""Logarithm of the ratio of two values between which no others are tried."""
Number = float | int


class NotReachedError(ForeseenError, ValueError):
    """No value of the option reaches the target; the message says what the best ones reach."""


def search(
    count: Callable[[Number], Number],
    target: Number,
    *,
    start: Number,
    low: Number,
    high: Number,
    tolerance: Number,
    whole: bool = False,
    counts: dict[Number, Number] | None = None,
) -> dict[Number, Number]:
    """Search for ``count(value) = target``; ``count`` is monotone, but the direction need not be
    known.

    Values and counts are compared by their ratios. Between two values on both sides of the target
    it interpolates, or bisects when one end stays; outside it follows the slope.

    Args:
        count: What is counted at a value.
        target: The count that is wanted.
        start: The first value, if it is between ``low`` and ``high``; else the nearer of these.
        low, high: Limits of the values.
        tolerance: A relative deviation from the target that is small enough to stop.
        whole: Only whole numbers.
        counts: Counts that are known already.

    Returns:
        Value -> count, in the order of evaluation; the one nearest to the target may be farther
        than ``tolerance``.
    """
    counts = {} if counts is None else counts

    def clamp(value: Number) -> Number:
        value = min(max(value, low), high)
        return round(value) if whole else value

    def ratio(n: Number, m: Number) -> float:
        least = 1e-4 * target  # a count of zero has no logarithm
        return math.log(max(n, least) / max(m, least))

    def move(value: Number, log_factor: float) -> Number:
        """Another value, at least a tenth away and not too far."""
        size = min(max(abs(log_factor), math.log(1.1)), math.log(_FARTHEST))
        value_there = clamp(value * math.exp(math.copysign(size, log_factor)))
        return (
            clamp(value + math.copysign(1, log_factor))
            if whole and value_there == value
            else value_there
        )

    def between(a: Number, b: Number) -> Number:
        share = ratio(target, counts[a]) / max(ratio(counts[b], counts[a]), 1e-9)
        recent = [n < target for n in list(counts.values())[-2:]]
        share = 0.5 if len(recent) == 2 and recent[0] == recent[1] else min(max(share, 0.1), 0.9)
        value = a * (b / a) ** share
        if not whole:
            return value
        inner_values = range(
            math.floor(min(a, b)) + 1,
            math.ceil(max(a, b)),
        )
        return min(inner_values, key=lambda v: abs(v - value)) if inner_values else a

    def beyond() -> Number:
        a = min(counts)
        b = max(counts)
        if a == b:  # as if the count were proportional to the value
            value = move(a, ratio(target, counts[a]))
            return value if value != a else move(a, -ratio(target, counts[a]))
        if counts[a] == counts[b]:  # no effect so far
            return high if high not in counts else low
        upwards = (counts[b] > counts[a]) == (target > counts[b])
        edge, inner, *_ = sorted(counts, reverse=upwards)
        if counts[edge] == counts[inner]:
            return high if upwards else low
        slope = ratio(counts[edge], counts[inner]) / math.log(edge / inner)
        return move(
            edge,
            abs(ratio(target, counts[edge]) / slope) * (1 if upwards else -1),
        )

    def following() -> Number | None:
        """The value to try next; None if the search has ended."""
        if len(counts) >= MOST_RUNS or min(_errors(counts, target).values()) <= tolerance:
            return None
        low_values = [v for v, n in counts.items() if n < target]
        high_values = [v for v, n in counts.items() if n >= target]
        if not (low_values and high_values):
            return beyond()
        a, b = min(
            itertools.product(low_values, high_values),
            key=lambda pair: abs(math.log(pair[0] / pair[1])),
        )
        return None if abs(math.log(a / b)) < _CLOSEST else between(a, b)

    value = following() if counts else clamp(start)
    while value is not None and value not in counts:
        counts[value] = count(value)
        value = following()
    return counts


def nearest(counts: Mapping[Number, Number], target: Number, tolerance: Number) -> Number:
    """The value whose count is nearest to the target.

    Raises:
        NotReachedError: it differs by more than ``tolerance``.
    """
    errors = _errors(counts, target)
    best = sorted(counts, key=errors.__getitem__)[:2]
    if errors[best[0]] <= tolerance:
        return best[0]
    if len(best) == 2 and len(set(counts.values())) == 1:
        a, b = best
        raise NotReachedError(f"this changes nothing: {a:g} and {b:g} both give {counts[a]:,.6g}")
    raise NotReachedError(" and ".join(f"{v:g} gives {counts[v]:,.6g}" for v in best))


def _errors(counts: Mapping[Number, Number], target: Number) -> dict[Number, float]:
    return {value: abs(n - target) / target for value, n in counts.items()}


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
    value = min(counts, key=_errors(counts, target).__getitem__)
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
