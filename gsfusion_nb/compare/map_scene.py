"""Mapping one scene for the lab: the data, the rule, what is counted, and time."""

import contextlib
import dataclasses
import functools
import itertools
import json
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import numpy as np

from ..code_keys.key import code_key, differing
from ..config import SystemConfig
from ..data import OpenedSequence, open_sequence
from ..data.adjust.repair import as_read
from ..data.adjust.selection import FrameSubset
from ..data.room import RoomSequence
from ..errors import ArgumentError
from ..mapping import Mapper, StepReport, make_mapper
from ..resources import PeakMemory
from ..runs import MappingRun
from ..runs.scores import score
from ..seeding import SeedingRule, get_rule, is_built_in, is_map_rule
from ..seeding.code_files import refuse_undeclared
from ..seeding.rule import option_paths
from ..seeding.rule_guard import only_declared
from ..types import Frame
from .rule_variants import original, thinned, variant_of
from .schedule import dotted, fixed_schedule, flat_settings, with_settings
from .spec import ONLY_NOW, RunSpec
from .training_code import training_functions

OnStep = Callable[[StepReport | None], object]
"""Called after each piece of work: with the report of a mapped frame, or with None."""
R = TypeVar("R")

RATE_HZ = 30
"""Frames per second of a depth camera, and of the recordings that the published intervals of rules
belong to."""
_warm: set[str] = set()
"""Systems and devices that have mapped in this process: nothing is compiled or loaded for them any
more."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Entry:
    """What takes part: a run, and the objects that a spec cannot hold."""

    spec: RunSpec
    rule: SeedingRule | None = None
    """The rule, if it was defined in this process and is not registered; by default the one that
    the spec names."""
    sequence: OpenedSequence | None = None
    """The frames, if the caller has opened them."""

    def opened(self) -> OpenedSequence:
        """The frames.

        Raises:
            SequenceError: they cannot be read.
        """
        if self.sequence is not None:
            return self.sequence
        reader = json.dumps(dict(self.spec.reader), sort_keys=True)
        return _open(
            self.spec.content,
            self.spec.data,
            reader,
            self.spec.config().data,
        )

    def found_rule(self) -> SeedingRule:
        """The rule, with all its seeds.

        Raises:
            KeyError: no such rule. ValueError: the source of the rule cannot be loaded.
        """
        return self.spec.found_rule() if self.rule is None else get_rule(self.rule)


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
    online: dict[str, Any]
    """Scores before the optimisation after the scan, if the spec asks for them."""

    @property
    def seconds(self) -> float:
        """Wall time of all mapping steps and of the optimisation after the scan."""
        return sum(s.total_seconds for s in self.run.steps) + self.run.global_passes.seconds


def map_scene(
    entry: Entry, config: SystemConfig, *, scratch: bool = False
) -> Generator[StepReport | None, None, Mapped]:
    """Map the frames of ``entry`` with the settings ``config``; yields the report of each frame,
    then None after each step of the optimisation after the scan, and returns the map.

    Args:
        entry: The run.
        config: Settings.
        scratch: A run that is not scored: memory is not measured.

    Raises:
        Exception: whatever the rule or the data raises.
    """
    sequence = entry.opened()
    if not is_built_in(original(entry.found_rule())):
        sequence = dataclasses.replace(sequence, mapping=_PrivateFrames(**vars(sequence.mapping)))
    config = _with_pace(config, sequence)
    _warm_up(sequence, config, entry.spec.device)
    memory = PeakMemory("cuda" if entry.spec.device.startswith("cuda") else "cpu")
    with contextlib.nullcontext() if scratch else memory:
        mapper, notes = _mapper(entry, config)
        if entry.spec.not_kept:
            notes.append(f"not kept for later commands: {entry.spec.not_kept}")
        notes += _questions(mapper, len(sequence.mapping))
        run = MappingRun(sequence, mapper)
        cpu_s = []
        n_steps = 0
        frames = run.online()
        while True:
            began = time.process_time()
            report = next(frames, None)
            if report is None:
                break
            cpu_s.append(time.process_time() - began)
            n_steps += report.n_steps
            yield report
        online = score(run, "_online") if entry.spec.online and not scratch else {}
        for _ in run.optimise():
            n_steps += 1
            yield None
    notes += _gaps(run)
    return Mapped(
        run=run,
        n_steps=n_steps,
        cpu_s=cpu_s,
        peak_mb=memory.peak_mb,
        notes=notes,
        online=online,
    )


def _gaps(run: MappingRun) -> list[str]:
    """Notes on frames that are not in the map, and on frames after which it was empty."""
    notes = []
    n = len(run.sequence.mapping)
    if len(run.steps) < n:
        skipped = "skipped a frame: "
        reasons = [text.removeprefix(skipped) for text in run.warnings if text.startswith(skipped)]
        why = f", the first because {reasons[0]}" if reasons else ""
        notes.append(f"{n - len(run.steps)} of {n} frames are not in the map{why}")
    empty = [report for report in run.steps if report.n_gaussians == 0]
    if empty:
        without = (
            "" if any(report.n_steps for report in empty) else ", so no gradient steps were taken"
        )
        notes.append(f"after {len(empty)} of {len(run.steps)} frames the map was empty{without}")
    return notes


def finished(
    steps: Generator[StepReport | None, None, R], on_step: OnStep = lambda report: None
) -> R:
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
    spec = entry.spec
    notes = []
    own = original(entry.found_rule())
    refuse_other_code(spec, own)
    rule = _asked_at_its_pace(entry.found_rule(), spec, config)
    if spec.keep_share < 1:
        rule = thinned(rule, spec.keep_share)
    functions = training_functions(spec.training)
    mapper = make_mapper(config, seeding=rule, device=spec.device, **functions)
    if not is_built_in(own):
        files = code_key(own).files
        refuse_undeclared(own, files)
        places = [*option_paths(own, spec.options).values(), *files]
        mapper.rule_in_use.call_context = lambda: only_declared(spec.rule_name, places)
    used = flat_settings(mapper.config)
    flat = flat_settings(config)
    for name, value in getattr(rule, "overrides", {}).items():
        # keyframe_every in a system that chooses its keyframes by motion
        if dotted(name) not in used:
            continue
        if used[dotted(name)] != value:
            notes.append(
                f"the rule's own {dotted(name)} = {value} is not used, but {used[dotted(name)]}"
            )
        elif flat[dotted(name)] != value:
            notes.append(
                f"the rule sets {dotted(name)} = {value}, in place of {flat[dotted(name)]}"
            )
    return mapper, notes


def refuse_other_code(spec: RunSpec, rule: SeedingRule) -> None:
    """Raise ``ValueError`` if the code of a run is not the one with which its comparison was
    started.

    A process keeps the modules that it has loaded, and another machine may have other files.
    """
    if spec.code is None:
        return
    spec_code = dict(spec.code)
    own_code = dict(spec.with_code(rule).code or {})
    for parts in (spec_code, own_code):
        parts.pop(ONLY_NOW, None)
    if spec_code != own_code:
        raise ArgumentError(
            f"the code of the rule {spec.rule_name} in this process is not the one with which the "
            f"comparison was started; different: {differing(spec_code, own_code)}. Start the "
            "comparison again, give every worker the same files and packages, and restart workers "
            "that loaded the code before it was edited"
        )


def _with_pace(config: SystemConfig, sequence: OpenedSequence) -> SystemConfig:
    """``config`` with the spacing of the frames of the built-in room, which is a walk of 49 s with
    few or many frames: the number of frames that a camera with 30 Hz takes from one to the next. A
    spacing in the settings stays."""
    source = as_read(sequence.source)
    if not isinstance(source, RoomSequence) or len(source) < 2 or config.seeding.source_stride:
        return config
    seconds = float(np.diff(source.times_s).mean()) * config.data.stride
    return with_settings(config, {"seeding.source_stride": max(1, round(RATE_HZ * seconds))})


def _asked_at_its_pace(rule: SeedingRule, spec: RunSpec, config: SystemConfig) -> SeedingRule:
    """A rule for keyframes, in the schedule that is the same for all rules, whose keyframes are for
    the optimisation: it is asked as often as its release makes keyframes (``keyframe_every`` of its
    settings)."""
    own = dict(getattr(rule, "overrides", {})).get("keyframe_every", 0)
    when = cast(Any, rule).when if is_map_rule(rule) else None
    if spec.budget.steps != "equal" or not (
        own and when and when.only_keyframes and hasattr(config, "keyframe_every")
    ):
        return rule
    variant: Any = variant_of(rule, lambda ctx, make: make(ctx))
    variant.when = dataclasses.replace(when, frames=own, only_keyframes=False)
    return variant


def _questions(mapper: Mapper, n_mapped: int) -> list[str]:
    """A note on when a rule is asked, if that is not in every frame."""
    when = mapper.rule_in_use.when
    stride = mapper.config.source_stride
    if when.only_keyframes or when.frames == 1:
        return []
    n = sum(when.is_due(i, None, stride=stride) for i in range(n_mapped))
    return [
        f"asked every {when.frames} frames of the recording, here in {n} of {n_mapped} mapped "
        "frames"
    ]


class _PrivateFrames(FrameSubset):
    """The frames of a run, whose images no other run has: what a rule does to them stays there."""

    def __getitem__(self, i: int) -> Frame:
        frame = super().__getitem__(i)
        images = {name: getattr(frame, name).clone() for name in ("colour", "depth_m", "T_WC")}
        return dataclasses.replace(
            frame,
            **images,
            extra={name: x.clone() for name, x in frame.extra.items()},
        )


def _warm_up(sequence: OpenedSequence, config: SystemConfig, device: str) -> None:
    """Map two frames once per process, so that compiling and loading is not timed in the first
    run."""
    name = f"{type(config).__name__} {device}"
    if name not in _warm:
        _warm.add(name)
        plain = with_settings(
            config, {"seeding.rule": "uniform", "seeding.options": {"coverage": False}}
        )
        run = MappingRun(sequence, make_mapper(plain, device=device))
        for _ in itertools.islice(run.online(), 2):
            pass


@functools.lru_cache(maxsize=4)
def _open(content: str, data: str, reader: str, settings) -> OpenedSequence:
    """The frames; opened again when the ``content`` of the files is another one."""
    return open_sequence(data, data=settings, **json.loads(reader))
