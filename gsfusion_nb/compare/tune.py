"""Reaching a budget: the option of a rule that decides its size, the search for its value, and the scratch runs."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from typing import Any

from ..config import SystemConfig
from ..errors import shown
from ..seeding import SeedingRule, rule_name, rule_options
from .map_scene import Entry, Mapped, budgeted, map_scene, observed
from .schedule import dotted, flat_settings, steps_per_frame, with_steps_per_frame, without_steps
from .spec import RunSpec, label_of

THIN = "thin"
"""Size option of any rule: the share of its seeds that is kept, drawn at random."""


@dataclass(frozen=True, kw_only=True)
class SizeOption:
    """A number that decides how many Gaussians a rule makes."""

    name: str
    """Option of the rule, a dotted setting, or "thin"."""
    low: float | int
    """Smallest value that is tried."""
    high: float | int
    """Largest value that is tried."""


SHARE = SizeOption(name="share", low=1e-5, high=1.0)
SIZE_OPTIONS: dict[str, SizeOption] = {
    "gsfusion": SizeOption(name="seeding.quadtree_threshold", low=1e-6, high=100.0),
    "uniform": SizeOption(name="fraction", low=1e-5, high=1.0),
    "edge_discs": SizeOption(name="spacing_px", low=1.0, high=200.0),
    "edge_strokes": SizeOption(name="spacing_px", low=1.0, high=200.0),
    "monogs": SizeOption(name="density", low=1e-4, high=128.0),
    "monogs_like": SizeOption(name="density", low=1e-4, high=128.0),
    "photo_slam": SizeOption(name="corners", low=1, high=100_000),
    "gs_icp": SizeOption(name="density", low=1e-3, high=100.0),
    "on_the_fly_nvs": SizeOption(name="density", low=1e-4, high=1e4),
    "cone_gs": SizeOption(name="share", low=1e-5, high=1e3),
    "vg_mapping": SizeOption(name="seeding.quadtree_threshold", low=1e-6, high=100.0),
    **dict.fromkeys(("default_strategy", "mcmc", "game"), SHARE),
    **dict.fromkeys(("cg_slam", "gaus_slam", "gaussian_slam", "gps_slam", "gs_slam", "hf_slam", "mm3dgs"), SHARE),
    **dict.fromkeys(("rtg_slam", "splatam", "splatam_like", "two_dgs_slam", "vings", "vtgaussian"), SHARE),
}
"""Registered rule -> its size option."""


def size_option(spec: RunSpec, rule: SeedingRule) -> SizeOption:
    """The size option of a run: the one that ``spec`` names, else the rule's own.

    Raises:
        ValueError: there is none, the rule does not have it, or it is not a number.
    """
    known = SIZE_OPTIONS.get(rule_name(rule)) if not spec.rule_source and not spec.rule_hash else None
    name = dotted(spec.size_option) or (known.name if known else "")
    if not name:
        raise ValueError(
            f"the rule {rule_name(rule)} has no size option: name the option that changes its number of Gaussians as "
            f'size_option (its options: {", ".join(rule_options(rule)) or "none"}), or "{THIN}", which keeps a random '
            f"share of its seeds"
        )
    if known is not None and name == known.name and spec.size_range is None:
        return known
    low, high = spec.size_range or _usual_range(spec, rule, name)
    return SizeOption(name=name, low=low, high=high)


def start_value(spec: RunSpec, rule: SeedingRule, option: SizeOption) -> float | int:
    """The value of the size option before it is tuned.

    Raises:
        ValueError: the rule and the settings do not have it, or it is not a number.
    """
    if option.name == THIN:
        return spec.keep_share
    values = {**flat_settings(spec.config()), **rule_options(rule), **spec.options}
    if option.name not in values:
        known = ", ".join([*rule_options(rule), THIN])
        raise ValueError(f"the rule {rule_name(rule)} has no option {shown(option.name)} to tune; known: {known}")
    value = values[option.name]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or value <= 0:
        raise ValueError(f"the size option {option.name} must be a number above 0, got {shown(value)}")
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


def described(option: SizeOption, value: float | int) -> str:
    """The tuned value in words: "fraction=0.1"."""
    return label_of("", {option.name: value}).strip()


def _usual_range(spec: RunSpec, rule: SeedingRule, name: str) -> tuple[float | int, float | int]:
    if name == THIN:
        return 1e-5, 1.0
    start = start_value(spec, rule, SizeOption(name=name, low=0, high=0))
    if isinstance(start, float) and start <= 1 and "." not in name:
        return 1e-5, 1.0
    return (1, 1000 * start) if isinstance(start, int) else (start / 1e4, start * 1e4)


MOST_RUNS = 24
"""Evaluations after which the search gives up."""
_FARTHEST = 8.0
"""Largest factor between the value of one evaluation and the next."""
_CLOSEST = 1e-3
"""Logarithm of the ratio of two values between which no others are tried."""


class NotReachedError(ValueError):
    """No value of the option reaches the target; the message says what the best ones reach."""


@dataclass(kw_only=True)
class Search:
    """A search for ``count(value) = target``; ``count`` is monotone, but the direction need not be known.

    It is asked for a value and told its count, until it has no further value:

        while (value := search.next_value()) is not None:
            search.tell(value, count(value))
        value = search.found()

    Values and counts are compared by their ratios. Between two values on both sides of the target it interpolates;
    outside it follows the slope.
    """

    target: float | int
    start: float | int
    """The first value, if it is between ``low`` and ``high``; else the nearer of these."""
    low: float | int
    high: float | int
    tolerance: float | int
    """A relative deviation from the target that is small enough to stop."""
    accepted: float | int = 0.0
    """A larger one that is accepted where no value comes closer, as for counts that change in steps."""
    whole: bool = False
    """Only whole numbers."""
    counts: dict[float | int, float | int] = field(default_factory=dict)
    """Value -> count, in the order of evaluation."""

    def next_value(self) -> float | int | None:
        """The value whose count is wanted next; None when the search has ended."""
        if not self.counts:
            return self._allowed(self.start)
        if len(self.counts) >= MOST_RUNS or self.error(self.best) <= self.tolerance:
            return None
        value = self._next()
        return None if value in self.counts else value

    def tell(self, value: float | int, count: float | int) -> None:
        """``count`` is the count at ``value``."""
        self.counts[value] = count

    @property
    def best(self) -> float | int:
        """The value whose count is closest to the target so far."""
        return min(self.counts, key=self.error)

    def found(self) -> float | int:
        """The best value, if it is close enough to the target.

        Raises:
            NotReachedError: it is not.
        """
        if self.error(self.best) > max(self.tolerance, self.accepted):
            raise NotReachedError(self._nearest())
        return self.best

    def error(self, value: float | int) -> float:
        """Relative deviation of the count at ``value`` from the target."""
        return abs(self.counts[value] - self.target) / self.target

    def _next(self) -> float | int:
        """The next value; one that is known already if no other can be better."""
        below = {v for v, n in self.counts.items() if n < self.target}
        above = set(self.counts) - below
        if below and above:
            a, b = min(((a, b) for a in below for b in above), key=lambda pair: abs(math.log(pair[0] / pair[1])))
            return a if abs(math.log(a / b)) < _CLOSEST else self._between(a, b)
        return self._beyond()

    def _between(self, a: float | int, b: float | int) -> float | int:
        """Interpolated in the logarithms; bisected when one end stays, so that it always ends."""
        share = self._log_ratio(self.target, a) / max(self._log_ratio(self.counts[b], a), 1e-9)
        recent = [n < self.target for n in list(self.counts.values())[-2:]]
        share = 0.5 if len(recent) == 2 and recent[0] == recent[1] else min(max(share, 0.1), 0.9)
        value = a * (b / a) ** share
        if not self.whole:
            return value
        between = range(math.floor(min(a, b)) + 1, math.ceil(max(a, b)))
        return min(between, key=lambda v: abs(v - value)) if between else a

    def _beyond(self) -> float | int:
        """Outside the values so far, towards the target."""
        a, b = min(self.counts), max(self.counts)
        if a == b:  # as if the count were proportional to the value
            factor = self._factor(self._log_ratio(self.target, a))
            value = self._moved(a, factor)
            return value if value != a else self._moved(a, 1 / factor)
        if self.counts[a] == self.counts[b]:  # no effect so far
            return self.high if self.high not in self.counts else self.low
        upwards = (self.counts[b] > self.counts[a]) == (self.target > self.counts[b])
        edge, *others = sorted(self.counts, reverse=upwards)
        if self.counts[edge] == self.counts[others[0]]:
            return self.high if upwards else self.low
        slope = self._log_ratio(self.counts[edge], others[0]) / math.log(edge / others[0])
        factor = self._factor(abs(self._log_ratio(self.target, edge) / slope))
        return self._moved(edge, factor if upwards else 1 / factor)

    def _factor(self, log_factor: float) -> float:
        """A factor for the next value: a change of at least a tenth, and not by too much."""
        size = min(max(abs(log_factor), math.log(1.1)), math.log(_FARTHEST))
        return math.exp(math.copysign(size, log_factor))

    def _moved(self, value: float | int, factor: float) -> float | int:
        moved = self._allowed(value * factor)
        if self.whole and moved == value:
            moved = self._allowed(value + (1 if factor > 1 else -1))
        return moved

    def _log_ratio(self, count: float | int, value: float | int) -> float:
        least = 1e-4 * self.target  # a count of zero has no logarithm
        return math.log(max(count, least) / max(self.counts[value], least))

    def _allowed(self, value: float | int) -> float | int:
        value = min(max(value, self.low), self.high)
        return round(value) if self.whole else value

    def _nearest(self) -> str:
        nearest = sorted(self.counts, key=self.error)[:2]
        if len(nearest) == 2 and len(set(self.counts.values())) == 1:
            a, b = nearest
            return f"this changes nothing: {a:g} and {b:g} both give {self.counts[a]:,.6g}"
        return " and ".join(f"{v:g} gives {self.counts[v]:,.6g}" for v in nearest)


TUNING_SEED = 1_000_003
"""Seed of tuning runs, so that tuning never sees the random numbers of a scored run."""
FAR_TOO_MANY = 4.0
"""A tuning run ends where its map has this many times the Gaussians that are wanted."""
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
            most = math.inf if "after_step" in used else FAR_TOO_MANY * target
            count = yield from _scratch_run(entry, option, int(tried) if whole else tried, settings, most)
            search.tell(tried, count)
            if settings is without_steps and _steps_matter(config, used):
                search.tolerance = 4 * tolerance  # a start for the search with all steps
        value, runs = search.best, runs + len(search.counts)
        too_few = (
            "after_step" not in used and search.counts[search.best] < target / 2
        )  # and seeding is most without steps
        if too_few or not _steps_matter(config, used):
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
    entry: Entry,
    option: SizeOption,
    value: float | int,
    settings: Callable[[SystemConfig], SystemConfig] | None,
    most: float,
) -> Generator[None, None, int]:
    """Gaussians in the map that this value gives; extrapolated from a run that is given up, at more than ``most``."""
    changed = dataclasses.replace(entry, spec=with_size(entry.spec, option, value))
    config, n_frames = budgeted(changed.spec), len(entry.opened().mapping)
    steps = map_scene(changed, settings(config) if settings else config, with_memory=False)
    for done in itertools.count(1):
        try:
            report = next(steps)
        except StopIteration as ended:
            return len(ended.value.run.mapper.gaussians)
        if report is not None and report.n_gaussians > most:
            return int(float(f"{report.n_gaussians * n_frames / done:.2g}"))
        yield None
    raise AssertionError


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
