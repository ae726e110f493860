"""Mapping one scene for the lab: opening the data, making the mapper as the budget says, counting steps and time."""

import contextlib
import functools
import json
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TypeVar

from ..config import SystemConfig
from ..data import OpenedSequence, open_sequence
from ..mapping import Mapper, StepReport, make_mapper
from ..memory import PeakMemory
from ..observing import observing
from ..runs import MappingRun
from ..seeding import SeedingRule, get_rule
from ..seeding.rule_file import rule_of_source
from .out_of_view import OutOfView
from .rule_variants import thinned
from .schedule import dotted, fixed_schedule
from .setting_names import flat_settings, with_settings
from .spec import RunSpec

S = TypeVar("S")
R = TypeVar("R")

_warm: set[str] = set()
"""Systems and devices that have mapped in this process: nothing is compiled or loaded for them any more."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Entry:
    """What takes part: a run, and the objects that a spec cannot hold."""

    spec: RunSpec
    rule: SeedingRule | None = None
    """The rule, if it was defined in this process and is not registered; by default the one that the spec names."""
    sequence: OpenedSequence | None = None
    """The frames, if the caller has opened them."""

    def opened(self) -> OpenedSequence:
        """The frames.

        Raises:
            SequenceError: they cannot be read.
        """
        if self.sequence is not None:
            return self.sequence
        return _open(self.spec.data, json.dumps(dict(self.spec.reader), sort_keys=True), self.spec.config().data)

    def found_rule(self) -> SeedingRule:
        """The rule, with all its seeds.

        Raises:
            KeyError: no such rule. ValueError: the source of the rule cannot be loaded.
        """
        if self.rule is None and self.spec.rule_source:
            file, _, name = self.spec.rule.rpartition(":")
            return rule_of_source(self.spec.rule_source, name, file)
        return get_rule(self.rule if self.rule is not None else self.spec.rule)


@dataclass(frozen=True, kw_only=True, eq=False)
class Mapped:
    """A mapped scene and what it cost."""

    run: MappingRun
    n_steps: int
    """Gradient steps, with those after the scan."""
    cpu_s: list[float]
    """CPU time of each frame, over all threads, seconds."""
    peak_mb: float | None
    """Growth of memory while mapping, MB; None where the system does not report it."""
    notes: list[str]
    """What differs from the other runs of a comparison."""

    @property
    def seconds(self) -> float:
        """Wall time of all mapping steps and of the optimisation after the scan."""
        return sum(s.total_seconds for s in self.run.steps) + self.run.seconds_global


def map_scene(
    entry: Entry, config: SystemConfig, *, with_memory: bool = True
) -> Generator[StepReport | None, None, Mapped]:
    """Map the frames of ``entry`` with the settings ``config``; yields the report of each frame, then None after each
    step of the optimisation after the scan, and returns the map.

    Args:
        entry: The run.
        config: Settings.
        with_memory: Measure the memory, which takes a third of a second.

    Raises:
        Exception: whatever the rule or the data raises.
    """
    sequence = entry.opened()
    _warm_up(sequence, config, entry.spec.device)
    memory = PeakMemory("cuda" if entry.spec.device.startswith("cuda") else "cpu")
    with memory if with_memory else contextlib.nullcontext():
        mapper, notes = _mapper(entry, config)
        run, cpu_s, n_steps = MappingRun(sequence, mapper), [], 0
        frames, unseen = run.online(), OutOfView()
        while True:
            began = time.process_time()
            with observing(unseen):
                report = next(frames, None)
            if report is None:
                break
            cpu_s.append(time.process_time() - began)
            n_steps += report.n_steps
            yield report
        for _ in run.optimise():
            n_steps += 1
            yield None
    empty = sum(report.n_gaussians == 0 for report in run.steps)
    if empty:
        notes.append(f"after {empty} of {len(run.steps)} frames the map was empty, so no gradient steps were taken")
    notes += unseen.note()
    return Mapped(run=run, n_steps=n_steps, cpu_s=cpu_s, peak_mb=memory.peak_mb, notes=notes)


def finished(steps: Generator[S, None, R], on_step: Callable[[S], object] = lambda step: None) -> R:
    """What ``steps`` return at their end; ``on_step`` is called with each thing that they yield."""
    while True:
        try:
            on_step(next(steps))
        except StopIteration as ended:
            return ended.value


def budgeted(spec: RunSpec) -> SystemConfig:
    """The settings of ``spec``, with the schedule that its budget asks for."""
    config = spec.config()
    return fixed_schedule(config) if spec.budget.steps == "equal" else config


def _mapper(entry: Entry, config: SystemConfig) -> tuple[Mapper, list[str]]:
    """A mapper with the rule of ``entry``, and notes on the settings that the rule brings."""
    spec, notes = entry.spec, []
    rule = entry.found_rule()
    if spec.keep_share < 1:
        rule = thinned(rule, spec.keep_share)
    mapper = make_mapper(config, seeding=rule, device=spec.device)
    used, given = flat_settings(mapper.config), flat_settings(config)
    for name, value in getattr(rule, "overrides", {}).items():
        if dotted(name) not in used:  # keyframe_every in a system that chooses its keyframes by motion
            continue
        if used[dotted(name)] != value:
            notes.append(f"the rule's own {dotted(name)} = {value} is not used, but {used[dotted(name)]}")
        elif given[dotted(name)] != value:
            notes.append(f"the rule sets {dotted(name)} = {value}, in place of {given[dotted(name)]}")
    return mapper, notes


def _warm_up(sequence: OpenedSequence, config: SystemConfig, device: str) -> None:
    """Map two frames once per process, so that compiling and loading is not timed in the first run."""
    name = f"{type(config).__name__} {device}"
    if name not in _warm:
        _warm.add(name)
        plain = with_settings(config, {"seeding.rule": "uniform", "seeding.options": {}})
        for _ in zip(range(2), MappingRun(sequence, make_mapper(plain, device=device)).online()):  # noqa: B905
            pass


@functools.lru_cache(maxsize=4)
def _open(data: str, reader: str, settings) -> OpenedSequence:
    return open_sequence(data, data=settings, **json.loads(reader))
