"""The check-up of a recording: read frames, examine each property, try the alternatives, combine the repairs."""

import itertools
import statistics
import time
from collections import abc
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...config import DataConfig, RepairConfig
from ...data.adjust.repair import apply_options
from ...data.open import detect_layout, known_layouts, open_sequence
from ...data.recorded.recorded_sequence import RecordedSequence
from ...data.sequence import Sequence
from ...drawing.page import PageGraph
from . import colour as judge_colour
from . import frames as judge_frames
from .edges import colour_motion, fit_colour, image_speeds, in_order, moving_together
from .explain import Explanation, explain, pairs_of
from .fit import Agreement, CalibrationCorrection, FitData, agreement, median_error
from .frames import OverFrames, graphs_of, measure_over_frames
from .judge_fit import agreement_finding, fit_findings
from .pictures import pictures_of, same_frames, top_view
from .report import CheckupReport, Finding, flags_of, reader_flags
from .sample import Sample, read_sample
from .stored_values import (
    DepthCode,
    clear_codes,
    code_finding,
    examine_files,
    find_codes,
    missing_finding,
    pose_finding,
    unit_finding,
)


def check_recording(
    sequence_or_path: str | Path | Sequence,
    *,
    data: DataConfig | None = None,
    frames: int = 250,
    pictures: bool = True,
    **reader_options: Any,
) -> CheckupReport:
    """Examine a recording: units, conventions, intrinsics, registration, times, images; and find the options that
    repair it.

    A property with alternatives is tried with all of them. The report names the alternative under which the depth
    images predict each other best (reprojection from frame to frame), and the options of ``gsfusion-nb map`` that
    select it.

    Args:
        sequence_or_path: Folder of a recording, "room", or any ``Sequence``.
        data: Range, depth limits and corrections to start from, for example those of an earlier report; held-out frames
            are examined too.
        frames: Approximate number of frames to read; a longer recording is read in windows of 31 consecutive frames.
        pictures: Also make the pictures of the page.
        reader_options: For ``open_sequence``: ``format``, options of the reader.

    Raises:
        SequenceError: the recording cannot be opened; the message says why.
    """
    started = time.perf_counter()
    given = replace(data or DataConfig(), hold_out_every=0)
    base, hint = _opened(sequence_or_path, reader_options)
    raw, findings = RepairConfig(), []
    if isinstance(base, RecordedSequence):
        raw, findings = examine_files(base, given.repair)
    given = replace(given, repair=combined(given.repair, raw))
    sequence = apply_options(base, given)
    sample = read_sample(sequence, frames=frames)
    pairs = pairs_of(sample)
    report = CheckupReport(
        name=sample.name,
        length=sample.length,
        frames_read=len(sample.frames),
        findings=[_readable_finding(sample, given.repair), *findings],
        data=given,
    )
    if not pairs:
        return report
    posed = getattr(base, "has_poses", True)
    found = (_examine if posed else _examine_without_poses)(sample, pairs, base, hint)
    mended, changed = _together(given, found.data), found.data != DataConfig()
    again = apply_options(base, mended)
    e, more = found.explanation, found.findings
    if e is not None:
        if changed:
            e = replace(e, repaired=_measured_again(again, same_frames(sequence, again, pairs), e.repaired))
        flags = flags_of(mended) if changed else ""
        more = [agreement_finding(e, flags, median_error(e.data, e.corrected.correction)), *more]
    if pictures:
        path = top_view(sample, e.interpretation) if e else ""
        report = replace(
            report,
            pictures=pictures_of(sequence, again, pairs, changed=changed and posed, posed=posed),
            graphs=[*([PageGraph("Path from above", path)] if path else []), *(graphs_of(found.over) if e else [])],
        )
    return replace(
        report,
        findings=[*report.findings, *more],
        data=mended,
        reader=hint if any(f.repair == reader_flags(hint) for f in more) else {},
        seconds=time.perf_counter() - started,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Found:
    findings: list[Finding]
    data: DataConfig
    """The repairs that are added to those the recording was read with."""
    over: OverFrames
    explanation: Explanation | None = None


def _examine(sample: Sample, pairs: abc.Sequence[tuple[int, int]], base: Sequence, hint: dict[str, Any]) -> _Found:
    """All findings that come from the frames read."""
    codes = find_codes(sample.frames)
    clear_codes(sample.frames, codes)
    e = explain(sample, pairs)
    correction, fields = e.corrected.correction, e.fields(sample.camera)
    over = measure_over_frames(sample, e.interpretation, correction)
    colour, colour_findings = _colour(sample, base, hint)
    limits = _limits(codes, fields.get("depth_factor", e.interpretation.depth_factor))
    frame_findings, skip, piece = _frame_findings(sample, over)
    if judge_colour.OF_OTHER_FRAMES in colour_findings[0].numbers:
        text = "Cannot be known before each colour image is paired with its depth image."
        exposure = Finding("exposure", "unknown", text)
    else:
        far = [(a, b) for a, b in pairs if b - a > 1] or list(pairs)
        exposure = judge_frames.exposure_finding(over, judge_frames.gains(sample, far, e.data, correction))
    repair = replace(combined(replace(e.interpretation, **fields), colour), skip=skip)
    return _Found(
        findings=[
            missing_finding(sample.frames),
            code_finding(codes, getattr(base, "depth_scale", None), flags_of(limits)),
            *fit_findings(e, sample.camera),
            *colour_findings,
            *frame_findings,
            exposure,
        ],
        data=replace(limits, start=piece.start, stop=piece.stop, repair=repair),
        over=over,
        explanation=e,
    )


def _examine_without_poses(
    sample: Sample, pairs: abc.Sequence[tuple[int, int]], base: Sequence, hint: dict[str, Any]
) -> _Found:
    """Findings on the images alone, and the repairs they ask for."""
    codes = find_codes(sample.frames)
    clear_codes(sample.frames, codes)
    limits, unit = _limits(codes, 1.0), unit_finding(sample, base)
    over = measure_over_frames(sample, RepairConfig(), CalibrationCorrection(), posed=False)
    colour, colour_findings = _colour(sample, base, hint)
    blurred, frozen = judge_frames.blurred_frames(over), judge_frames.repeated_frames(over, posed=False)
    skip = tuple(sorted({*blurred, *frozen}))
    return _Found(
        findings=[
            missing_finding(sample.frames),
            code_finding(codes, getattr(base, "depth_scale", None), flags_of(limits)),
            unit,
            *colour_findings,
            judge_frames.sharpness_finding(over, blurred),
            judge_frames.frozen_finding(over, frozen, posed=False),
            pose_finding(),
        ],
        data=replace(limits, repair=replace(colour, depth_factor=unit.numbers["factor"], skip=skip)),
        over=over,
    )


def _colour(sample: Sample, base: Sequence, hint: dict[str, Any]) -> tuple[RepairConfig, list[Finding]]:
    """Findings on colour beside depth; the reader's own registration is a better repair than a shift."""
    speed = image_speeds(sample)
    times = [] if getattr(base, "no_times", "") else list(getattr(base, "timestamps_s", ()))
    evidence = judge_colour.ColourEvidence(
        fit=fit_colour(sample),
        motion=colour_motion(sample, speed),
        order=in_order(sample),
        together=moving_together(sample, speed),
        step_s=statistics.median(b - a for a, b in itertools.pairwise(times)) if len(times) > 1 else 0.0,
    )
    repair, findings = judge_colour.registration_findings(evidence, sample.camera)
    if hint and findings[0].verdict in ("doubtful", "wrong"):
        return RepairConfig(), [replace(findings[0], repair=reader_flags(hint)), *findings[1:]]
    return repair, findings


def _frame_findings(sample: Sample, over: OverFrames) -> tuple[list[Finding], tuple[int, ...], DataConfig]:
    """Findings on jumps, blur and frozen images, with the frames to leave out and the range to keep."""
    alone, cuts = judge_frames.find_jumps(over)
    blurred, frozen = judge_frames.blurred_frames(over), judge_frames.repeated_frames(over)
    piece = DataConfig()
    if cuts:
        start, stop = judge_frames.longest_piece(cuts, 1 + max(int(over.number.max()), sample.length - 1))
        piece = DataConfig(start=start, stop=stop)
    motion = judge_frames.motion_finding(over)
    findings = [
        *([motion] if motion else []),
        judge_frames.jump_finding(over, alone, cuts, flags_of(replace(piece, repair=RepairConfig(skip=tuple(alone))))),
        judge_frames.sharpness_finding(over, blurred),
        judge_frames.frozen_finding(over, frozen),
    ]
    return findings, tuple(sorted({*alone, *blurred, *frozen})), piece


def combined(first: RepairConfig, second: RepairConfig) -> RepairConfig:
    """One correction equal to ``first`` followed by ``second``: factors are multiplied, shifts added, other values
    replaced."""
    changes = dict(second.changes)
    for name in ("depth_factor", "translation_factor", "rgb_scale"):
        changes[name] = getattr(first, name) * getattr(second, name)
    for name in ("pose_shift_frames", "rgb_shift_frames", "pixel_shift", "rgb_shift_x_px", "rgb_shift_y_px"):
        changes[name] = getattr(first, name) + getattr(second, name)
    if second.pose_offset_s and first.pose_offset_s:
        raise ValueError("a time offset of the poses was set already")
    changes["skip"] = tuple(sorted({*first.skip, *second.skip}))
    return replace(first, **changes)  # pyright: ignore[reportArgumentType]


def _together(given: DataConfig, more: DataConfig) -> DataConfig:
    """Range, limits and corrections: those the recording was read with, and those found."""
    changes = {n: getattr(more, n) for n in ("start", "stop", "depth_min_m", "depth_max_m") if getattr(more, n)}
    return replace(given, repair=combined(given.repair, more.repair), **changes)


def _opened(sequence_or_path: str | Path | Sequence, reader_options: dict[str, Any]) -> tuple[Sequence, dict[str, Any]]:
    """The sequence as its reader returns it, and the option of the reader that registers colour to depth."""
    if not isinstance(sequence_or_path, (str, Path)):
        return sequence_or_path, {}
    source = open_sequence(sequence_or_path, **reader_options).source
    layout = reader_options.get("format", "auto")
    if layout == "auto" and isinstance(source, RecordedSequence):
        layout = detect_layout(Path(sequence_or_path).expanduser())
    registration = known_layouts()[layout].registration if layout in known_layouts() else {}
    return source, {} if any(reader_options.get(name) for name in registration) else dict(registration)


def _readable_finding(sample: Sample, given: RepairConfig) -> Finding:
    tried = len(sample.frames) + len(sample.unreadable)
    # a shift in time leaves these frames without a pose
    ends = max(abs(given.pose_shift_frames), abs(given.rgb_shift_frames))
    bad = {i: why for i, why in sample.unreadable.items() if ends <= i <= sample.length - 1 - ends}
    numbers = {"tried": float(tried), "unusable": float(len(bad))}
    if not bad:
        return Finding("frames", "ok", f"All {tried} frames read are usable.", numbers)
    text = f"{len(bad)} of {tried} frames cannot be used and are left out of the map, the first because "
    text += f"{next(iter(bad.values()))}."
    if len(sample.frames) >= 2 and len(bad) <= tried / 2:
        return Finding("frames", "doubtful", text, numbers)
    return Finding("frames", "wrong", text, numbers, "repair the files named here")


def _limits(codes: abc.Sequence[DepthCode], factor: float) -> DataConfig:
    """Depth limits that exclude the codes, metres, after the depth factor."""
    data = DataConfig()
    for code in codes:
        value = code.value_m * factor
        if code.high:
            data = replace(data, depth_max_m=round(0.99 * value, 3))
        else:
            data = replace(data, depth_min_m=round(1.01 * value, 4))
    return data


def _measured_again(sequence: Sequence, pairs: abc.Sequence[tuple[int, int]], claimed: Agreement) -> Agreement:
    """How well frames of the repaired recording agree, at positions in it; as ``claimed`` if it has none of them."""
    sample = read_sample(sequence, at=sorted({p for pair in pairs for p in pair}))
    there = sample.by_place
    kept = [(a, b) for a, b in pairs if a in there and b in there and b - a > 1]
    return agreement(FitData.of(sample, kept, RepairConfig()), CalibrationCorrection()) if kept else claimed
