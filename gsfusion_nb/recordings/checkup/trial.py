"""Repairs tried before they are advised: the recording is read with them, and its frames are
compared again."""

import itertools
import math
from collections import abc
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...config import DataConfig, RepairConfig
from ...data.adjust.poses import times_of
from ...data.adjust.selection import apply_options
from ...data.sequence import Sequence
from .agreement import CalibrationCorrection, FitData
from .edges import depth_edges, on_edges
from .explain import Explanation
from .frames import gains
from .report import Finding
from .sample import Sample, read_sample
from .stored_values import clear_codes

LIMITS = ("start", "stop", "depth_min_m", "depth_max_m")
_LEAST_GAIN = 0.001
"""A repair is advised if this share more of the points agree, which the digits that are shown can
show, ..."""
_LEAST_CONTRAST = 1.02
"""... or if colour has so many times the contrast on depth edges, and ..."""
_MOST_LOSS = 0.01
"""... at most this share less of the points agree: what registers colour hardly changes how frames
agree."""
_SAME_TIME = 0.2
"""A share of a time offset below this, in frames, is none."""


class Trial(NamedTuple):
    """How well the frames agree, as they were read."""

    share: float
    """Share of the points of a frame that agree with another frame in depth (3 per cent) and in
    brightness; NaN: not measured, since too few points meet a depth."""
    contrast: float
    """Contrast of colour on the depth edges, relative to the neighbourhood."""

    def is_measured(self, reference: "Trial") -> bool:
        """Whether this and ``reference`` can be compared."""
        return not math.isnan(self.share) and not math.isnan(reference.share)

    def gains(self, reference: "Trial") -> bool:
        """Whether this is better than ``reference``, or cannot be compared with it: what was not
        measured is no reason against a repair."""
        if not self.is_measured(reference):
            return True
        sharper = self.contrast > _LEAST_CONTRAST * reference.contrast
        return self.share > reference.share + _LEAST_GAIN or (
            sharper and self.share > reference.share - _MOST_LOSS
        )

    def beside(self, reference: "Trial") -> str:
        """Both in words, without the repair first."""
        if not self.is_measured(reference):
            return "too few points meet a depth in the other frame to measure how many agree"
        return (
            f"{reference.share:.1%} -> {self.share:.1%} of the points agree in depth and "
            "brightness, "
            f"contrast on depth edges {reference.contrast:.2f} -> {self.contrast:.2f}"
        )


def combined(first: DataConfig, second: DataConfig) -> DataConfig:
    """One correction equal to ``first`` followed by ``second``: factors are multiplied, shifts
    added, other values replaced."""
    a = first.repair
    b = second.repair
    changes = dict(b.changes)
    for name in ("depth_factor", "translation_factor", "rgb_scale"):
        changes[name] = getattr(a, name) * getattr(b, name)
    for name in (x for x in b.changes if "_shift" in x or "_offset" in x):
        changes[name] = getattr(a, name) + getattr(b, name)
    changes["skip"] = tuple(sorted({*a.skip, *b.skip}))
    limits = {name: getattr(second, name) for name in LIMITS if getattr(second, name)}
    return replace(first, **limits, repair=replace(a, **changes))  # pyright: ignore[reportArgumentType]


def without(more: DataConfig, fields: abc.Collection[str]) -> DataConfig:
    """The same with the defaults of these fields."""
    default = DataConfig()
    parts = [
        {x: getattr(part, x) for x in fields if hasattr(part, x)}
        for part in (default, default.repair)
    ]
    return replace(
        more,
        **parts[0],
        repair=replace(more.repair, **parts[1]),
    )


class Trials:
    """Trials of one recording.

    Args:
        base: As its reader returns it.
        initial: What it is examined with.
    """

    def __init__(self, base: Sequence, initial: DataConfig):
        self.base = base
        self._given = replace(initial, hold_out_every=0)
        self.pairs: list[tuple[int, int]] = []
        """Numbers of the frames that are compared."""
        self._mapped = set(apply_options(base, initial).mapping.positions)
        self._known: dict[str, Trial] = {}

    def mapped(self, sample: Sample) -> Sample:
        """The sample with only those of its frames that are mapped: repairs are estimated from
        these."""
        return replace(sample, frames=[f for f in sample.frames if f.number in self._mapped])

    def of(
        self,
        more: DataConfig,
        base: Sequence | None = None,
        among: list[tuple[int, int]] | None = None,
    ) -> Trial:
        """The trial of a repair, or of another reading ``base`` of the recording, ``among`` other
        pairs."""
        data = combined(self._given, more)
        base = base or self.base
        among = self.pairs if among is None else among
        key = repr((data, id(base), among))
        if key not in self._known:
            sequence = apply_options(base, data)
            place = {number: i for i, number in enumerate(sequence.positions)}
            pairs = [(place[a], place[b]) for a, b in among if a in place and b in place]
            sample = read_sample(sequence, at=sorted({*itertools.chain(*pairs)}))
            pairs = [pair for pair in pairs if sample.by_place.keys() >= {*pair}]
            self._known[key] = Trial(0.0, 0.0)
            if pairs:
                shares = gains(
                    sample,
                    pairs,
                    FitData.of(sample, pairs, RepairConfig()),
                    CalibrationCorrection(),
                )[2]
                edges = [depth_edges(f.depth_m.numpy()) for f in sample.frames]
                finite_shares = shares[~np.isnan(shares)]
                share = float(finite_shares.mean()) if len(finite_shares) else math.nan
                self._known[key] = Trial(share, on_edges(edges, sample.frames))
        return self._known[key]

    def in_time(self, e: Explanation, sample: Sample) -> tuple[Explanation, Sample]:
        """The explanation with offsets of both sensors instead of a shift of the poses, and the
        sample read with them.

        Depth shows how late it is beside the poses. What share of that the pictures have, too, is
        where most points agree, by the parabola through none, half and all of it. Without times
        both are as they were.
        """
        times = times_of(self.base)
        late = e.repair.pose_shift_frames
        if times is None or not late or self._given.repair.pose_shift_frames:
            return e, sample
        late_s = late * float(times.diff().median())
        rest = replace(e.repair, pose_shift_frames=0.0)

        def offsets(share: float) -> RepairConfig:
            share = next(
                (whole for whole in (0.0, 1.0) if abs(late * (share - whole)) < _SAME_TIME),
                share,
            )
            return replace(
                rest,
                pose_offset_s=round(share * late_s, 4),
                depth_offset_s=round((1 - share) * late_s, 4),
            )

        none, half, whole = (
            self.of(DataConfig(repair=offsets(share))).share for share in (0.0, 0.5, 1.0)
        )
        bend = none - 2 * half + whole
        best = 0.5 + (none - whole) / (4 * bend) if bend < 0 else float(whole > none)
        repair = offsets(min(max(best, 0.0), 1.0))
        offset_repair = RepairConfig(
            pose_offset_s=repair.pose_offset_s, depth_offset_s=repair.depth_offset_s
        )
        data = combined(self._given, DataConfig(repair=offset_repair))
        read = read_sample(
            apply_options(self.base, data),
            at=[f.place for f in sample.frames],
        )
        clear_codes(read.frames, None)
        return replace(e, repair=repair, correction=replace(e.correction, shift_frames=0.0)), read

    def judged(
        self, findings: list[Finding], more: DataConfig, registered_base: Sequence | None
    ) -> tuple[list[Finding], DataConfig, str]:
        """The findings with what their repairs gain beside all others, the repairs that gain, and
        what these gain together. ``registered_base`` is the recording with the reader's option that
        registers it, if that is advised."""
        left_out = {*more.repair.skip, more.start, more.stop} - {0}
        jump_pairs = [(n + k - 1, n + k) for n in sorted(left_out) for k in (-1, 0, 1, 2)]
        repairs = more
        verdicts = []
        read = self.base
        for f in findings:
            options = [
                word.removeprefix("--data.")
                for word in f.repair.split()
                if word.startswith("--data.")
            ]
            rest = without(
                repairs, [option.removeprefix("repair.").replace("-", "_") for option in options]
            )
            other = registered_base if f.repair.startswith("--reader") else None
            if other is not None or rest != repairs:
                among = jump_pairs if {"start", "stop", "repair.skip"} & {*options} else None
                reference = self.of(rest, among=among)
                trial = self.of(repairs, other, among)
                is_better = trial.gains(reference)
                if is_better:
                    self.base = other or self.base
                    note = f"Tried: {trial.beside(reference)}."
                    if not trial.is_measured(reference):
                        note = f"Could not be tried: {trial.beside(reference)}."
                    f = replace(f, sentence=f"{f.sentence} {note}")
                else:
                    repairs = rest
                    f = _vetoed(f, options, trial.beside(reference))
            verdicts.append(f)
        if repairs == DataConfig() and self.base is read:
            return verdicts, repairs, ""
        positions = {*apply_options(self.base, combined(self._given, repairs)).positions}
        both = [pair for pair in self.pairs if positions.issuperset(pair)]
        return (
            verdicts,
            repairs,
            self.of(repairs, among=both).beside(self.of(DataConfig(), read, both)),
        )


def _vetoed(f: Finding, options: list[str], comparison: str) -> Finding:
    """A finding whose repair gains nothing: what a fit took for wrong is not known; what was seen
    in the images stays true."""
    sentence = (
        f"Cannot be known from these frames: {f.repair} was tried, and is no better: {comparison}."
    )
    if {*options} & {"repair.skip", *(limit.replace("_", "-") for limit in LIMITS)}:
        sentence = f"{f.sentence} Tried, and no better: {comparison}."
    return replace(f, verdict="unknown", sentence=sentence, repair="")
