"""Repairs tried before they are advised: the recording is read with them, and its frames are compared again."""

import itertools
from collections import abc
from dataclasses import replace
from typing import NamedTuple

from ...config import DataConfig, RepairConfig
from ...data.adjust.poses import PosePath, stored_poses, times_of
from ...data.adjust.repair import apply_options
from ...data.sequence import Sequence
from .colour import depth_edges, on_edges
from .explain import Explanation
from .fit import CalibrationCorrection, FitData
from .frames import gains
from .report import Finding
from .sample import Sample, read_sample
from .stored_values import clear_codes

LIMITS = ("start", "stop", "depth_min_m", "depth_max_m")
_FIELDS = {
    "depth codes": ("depth_min_m", "depth_max_m"),
    "depth scale": ("depth_factor", "translation_factor"),
    "depth kind": ("depth_kind",),
    "pose direction": ("poses",),
    "pose axes": ("axes",),
    "quaternion order": ("quaternions",),
    "pose time": ("pose_shift_frames", "pose_offset_s", "depth_offset_s"),
    "focal length": ("fx", "fy"),
    "principal point": ("cx", "cy"),
    "registration": ("rgb_mirror", "rgb_shift_x_px", "rgb_shift_y_px", "rgb_scale"),
    "colour time": ("rgb_shift_frames",),
    "sharpness": ("skip",),
    "frozen frames": ("skip",),
    "pose jumps": ("skip", "start", "stop"),
}
"""Finding -> the fields of its repair."""
LEAST_GAIN = 0.0005
"""A repair is advised if this share more of the points agree, ..."""
_LEAST_CONTRAST = 1.02
"""... or if colour has so many times the contrast on depth edges, and ..."""
_MOST_LOSS = 0.01
"""... at most this share less of the points agree: what registers colour hardly changes how frames agree."""
_SAME_TIME = 0.2
"""Offsets nearer to none, in frames, are none."""


class Trial(NamedTuple):
    """How well the frames agree, as they were read."""

    share: float
    """Share of the points of a frame that agree with another frame in depth (3 per cent) and in brightness."""
    contrast: float
    """Contrast of colour on the depth edges, relative to the neighbourhood."""

    def gains(self, before: "Trial") -> bool:
        """Whether this is better than ``before``."""
        sharper = self.contrast > _LEAST_CONTRAST * before.contrast
        return self.share > before.share + LEAST_GAIN or (sharper and self.share > before.share - _MOST_LOSS)

    def beside(self, before: "Trial") -> str:
        """Both in words, without the repair first."""
        return (
            f"{before.share:.1%} -> {self.share:.1%} of the points agree in depth and brightness, contrast on depth "
            f"edges {before.contrast:.2f} -> {self.contrast:.2f}"
        )


def combined(first: DataConfig, second: DataConfig) -> DataConfig:
    """One correction equal to ``first`` followed by ``second``: factors are multiplied, shifts added, other values
    replaced."""
    a, b = first.repair, second.repair
    changes = dict(b.changes)
    for name in ("depth_factor", "translation_factor", "rgb_scale"):
        changes[name] = getattr(a, name) * getattr(b, name)
    for name in (
        "pose_shift_frames", "pose_offset_s", "depth_offset_s",
        "rgb_shift_frames", "pixel_shift", "rgb_shift_x_px", "rgb_shift_y_px",
    ):  # fmt: skip
        changes[name] = getattr(a, name) + getattr(b, name)
    changes["skip"] = tuple(sorted({*a.skip, *b.skip}))
    limits = {name: getattr(second, name) for name in LIMITS if getattr(second, name)}
    return replace(first, **limits, repair=replace(a, **changes))  # pyright: ignore[reportArgumentType]


def part_of(more: DataConfig, fields: abc.Collection[str]) -> DataConfig:
    """Only these fields of it."""
    limits = {name: getattr(more, name) for name in LIMITS if name in fields}
    changes = {name: value for name, value in more.repair.changes.items() if name in fields}
    return DataConfig(**limits, repair=RepairConfig(**changes))  # pyright: ignore[reportArgumentType]


class Trials:
    """Trials of one recording.

    Args:
        base: As its reader returns it.
        given: What it was examined with.
        pairs: Numbers of the frames that are compared.
    """

    def __init__(self, base: Sequence, given: DataConfig, pairs: abc.Sequence[tuple[int, int]]):
        self._base, self._given, self._pairs = base, replace(given, hold_out_every=0), list(pairs)
        self._known: dict[str, Trial] = {}

    def of(self, more: DataConfig, base: Sequence | None = None) -> Trial:
        """The trial of a repair, or of another reading ``base`` of the recording."""
        data = combined(self._given, more)
        key = repr(data) if base is None else ""
        if key not in self._known:
            sequence = apply_options(base or self._base, data)
            place = {number: i for i, number in enumerate(sequence.positions)}
            pairs = [(place[a], place[b]) for a, b in self._pairs if a in place and b in place]
            sample = read_sample(sequence, at=sorted({p for pair in pairs for p in pair}))
            self._known[key] = trial_of(sample, pairs)
        return self._known[key]

    def in_time(self, e: Explanation, sample: Sample) -> tuple[Explanation, Sample]:
        """The explanation with offsets of both sensors instead of a shift of the poses, and the sample read with them.

        Depth shows how late it is beside the poses. What share of that the pictures have, too, is where most points
        agree, by the parabola through none, half and all of it. Without times both are as they were.
        """
        times, late = times_of(self._base), e.repair.pose_shift_frames
        if times is None or not late or self._given.repair.pose_shift_frames:
            return e, sample
        late_s = late * PosePath(times, stored_poses(self._base)).step_s
        rest = replace(e.repair, pose_shift_frames=0.0)

        def offsets(share: float) -> RepairConfig:
            share = next((whole for whole in (0.0, 1.0) if abs(late * (share - whole)) < _SAME_TIME), share)
            return replace(rest, pose_offset_s=round(share * late_s, 4), depth_offset_s=round((1 - share) * late_s, 4))

        none, half, whole = (self.of(DataConfig(repair=offsets(share))).share for share in (0.0, 0.5, 1.0))
        bend = none - 2 * half + whole
        best = 0.5 + (none - whole) / (4 * bend) if bend < 0 else float(whole > none)
        repair = offsets(min(max(best, 0.0), 1.0))
        data = combined(self._given, part_of(DataConfig(repair=repair), _FIELDS["pose time"]))
        read = read_sample(apply_options(self._base, data), at=[f.place for f in sample.frames])
        clear_codes(read.frames, None)
        return replace(e, repair=repair, correction=replace(e.correction, shift_frames=0.0)), read

    def judged(self, found: list[Finding], more: DataConfig) -> tuple[list[Finding], DataConfig, str]:
        """The findings with what their repairs gain beside all others, the repairs that gain, and what these gain
        together."""
        kept, said = more, {}
        for name in [f.name for f in found if f.name in _FIELDS]:
            rest = [x for fields in _FIELDS.values() for x in fields if x not in _FIELDS[name]]
            without = part_of(kept, rest)
            if without == kept:
                continue
            before, after = self.of(without), self.of(kept)
            if after.gains(before):
                said[name] = f" Tried: {after.beside(before)}."
            else:
                said[name], kept = f" Tried, and no better: {after.beside(before)}.", without
        judged = []
        for f in found:
            if f.repair and f.name in said:
                gained = part_of(kept, _FIELDS[f.name]) != DataConfig()
                f = replace(f, sentence=f.sentence + said[f.name])
                f = f if gained else replace(f, verdict="unknown", repair="")
            judged.append(f)
        return judged, kept, self.of(kept).beside(self.of(DataConfig())) if kept != DataConfig() else ""


def trial_of(sample: Sample, pairs: abc.Sequence[tuple[int, int]]) -> Trial:
    """How well the frames of a sample agree."""
    there = sample.by_place
    pairs = [(a, b) for a, b in pairs if a in there and b in there]
    if not pairs:
        return Trial(0.0, 0.0)
    _, _, shares = gains(sample, pairs, FitData.of(sample, pairs, RepairConfig()), CalibrationCorrection())
    frames = [there[place] for place in sorted({*itertools.chain(*pairs)})]
    return Trial(float(shares.mean()), on_edges([depth_edges(f.depth_m.numpy()) for f in frames], frames))
