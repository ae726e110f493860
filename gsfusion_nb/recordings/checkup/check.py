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
from . import judge_colour, judge_fit, judge_frames, judge_intrinsics
from .alignment import fit_colour, in_order
from .colour_motion import colour_motion, image_speeds, moving_together
from .conventions import pairs_of
from .depth_values import DepthCode, clear_codes, code_finding, find_codes, missing_finding
from .explain import Alternative, Explanation, explain, repair_fields
from .file_checks import examine_files
from .findings import Finding, flags_of
from .frame_to_frame import OverFrames, gains, measure_over_frames
from .geometry_fit import CalibrationCorrection, FitData, agreeing, median_error
from .pictures import pictures_of, same_frames, top_view
from .repeated import same_images
from .report import CheckupReport
from .sample import Sample, read_sample
from .without_poses import pose_finding, unit_finding


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
        reader_options: For ``open_sequence``: ``format``, ``split``, options of the reader.

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
    common: dict[str, Any] = {"name": sample.name, "length": sample.length, "frames_read": len(sample.frames)}
    findings.insert(0, _readable_finding(sample, given.repair))
    if not pairs:
        return CheckupReport(**common, findings=findings, data=given)
    if not getattr(base, "has_poses", True):
        alone, more = _examine_without_poses(sample, sequence, base, hint)
        shown = pictures_of(sequence, sequence, pairs, changed=False, posed=False) if pictures else {}
        findings, seconds = [*findings, *alone], time.perf_counter() - started
        reader = hint if any(f.repair == _reader_flags(hint) for f in alone) else {}
        return CheckupReport(
            **common, findings=findings, data=_together(given, more), reader=reader, pictures=shown, seconds=seconds
        )
    found = _examine(sample, pairs, sequence, base, hint)
    mended = _together(given, found.data)
    changed = found.data != DataConfig()
    again = apply_options(base, mended)
    e = found.explanation
    if changed:
        e = replace(e, after=_measured_again(again, same_frames(sequence, again, pairs), e.after))
        e = replace(e, rows=[replace(e.after, what="with all repairs", flags=flags_of(mended)), *e.rows])
    findings.append(judge_fit.agreement_finding(e, found.usual_error))
    return CheckupReport(
        **common,
        findings=[*findings, *found.findings],
        data=mended,
        reader=hint if any(f.repair == _reader_flags(hint) for f in found.findings) else {},
        rows=e.rows,
        over=found.over,
        pictures=pictures_of(sequence, again, pairs, changed=changed) if pictures else {},
        top_view=top_view(sample, e.interpretation) if pictures else "",
        seconds=time.perf_counter() - started,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Found:
    findings: list[Finding]
    data: DataConfig
    """The repairs that are added to those the recording was read with."""
    explanation: Explanation
    over: OverFrames
    usual_error: float


def _examine(
    sample: Sample, pairs: abc.Sequence[tuple[int, int]], sequence: Sequence, base: Sequence, hint: dict[str, Any]
) -> _Found:
    """All findings that come from the frames read."""
    codes = find_codes(sample.frames)
    clear_codes(sample.frames, codes)
    e = explain(sample, pairs)
    correction = e.corrected.correction
    fields = repair_fields(correction, sample.camera, e.interpretation)
    over = measure_over_frames(sample, e.interpretation, correction)
    colour, colour_findings = _colour(sample, base, hint)
    limits = _limits(codes, fields.get("depth_factor", e.interpretation.depth_factor))
    frame_findings, skip, piece = _frame_findings(sample, sequence, over)
    close = [(a, b) for a, b in pairs if b - a > 1] or list(pairs)
    data = replace(
        limits, start=piece.start, stop=piece.stop, repair=combined(replace(e.interpretation, **fields), colour)
    )
    findings = [
        missing_finding(sample.frames),
        code_finding(codes, base.depth_scale if isinstance(base, RecordedSequence) else None, flags_of(limits)),
        judge_fit.scale_finding(e, sample.camera),
        judge_fit.kind_finding(e),
        *judge_fit.convention_findings(e),
        judge_fit.time_finding(e, sample.camera),
        *judge_intrinsics.intrinsics_findings(e, sample.camera),
        *colour_findings,
        *frame_findings,
        judge_frames.exposure_finding(over, gains(sample, close, e.data, correction))
        if judge_colour.OF_OTHER_FRAMES not in colour_findings[0].numbers
        else judge_frames.exposure_unknown(),
    ]
    return _Found(
        findings=findings,
        data=replace(data, repair=replace(data.repair, skip=skip)),
        explanation=e,
        over=over,
        usual_error=median_error(e.data, correction),
    )


def _examine_without_poses(
    sample: Sample, sequence: Sequence, base: Sequence, hint: dict[str, Any]
) -> tuple[list[Finding], DataConfig]:
    """Findings on the images alone, and the repairs they ask for."""
    codes = find_codes(sample.frames)
    clear_codes(sample.frames, codes)
    limits, unit = _limits(codes, 1.0), unit_finding(sample, base)
    over = measure_over_frames(sample, RepairConfig(), CalibrationCorrection(), posed=False)
    colour, colour_findings = _colour(sample, base, hint)
    blurred, frozen = judge_frames.blurred_frames(over), same_images(sequence, sample, over)
    skip = tuple(sorted({*blurred, *frozen}))
    factor = unit.numbers["factor"]
    findings = [
        missing_finding(sample.frames),
        code_finding(codes, base.depth_scale if isinstance(base, RecordedSequence) else None, flags_of(limits)),
        unit,
        *colour_findings,
        judge_frames.sharpness_finding(over, blurred, RepairConfig(skip=tuple(blurred)).flags),
        judge_frames.frozen_finding(over, frozen, RepairConfig(skip=tuple(frozen)).flags, posed=False),
        pose_finding(),
    ]
    return findings, replace(limits, repair=replace(colour, depth_factor=factor, skip=skip))


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
        return RepairConfig(), [replace(findings[0], repair=_reader_flags(hint)), *findings[1:]]
    return repair, findings


def _frame_findings(
    sample: Sample, sequence: Sequence, over: OverFrames
) -> tuple[list[Finding], tuple[int, ...], DataConfig]:
    """Findings on jumps, blur and frozen images, with the frames to leave out and the range to keep."""
    alone, cuts = judge_frames.find_jumps(over)
    moved = set(judge_frames.frozen_frames(over))
    blurred, frozen = (
        judge_frames.blurred_frames(over),
        {n: w for n, w in same_images(sequence, sample, over).items() if n in moved},
    )
    piece = DataConfig()
    if cuts:
        start, stop = judge_frames.longest_piece(cuts, 1 + max(int(over.number.max()), sample.length - 1))
        piece = DataConfig(start=start, stop=stop)
    motion = judge_frames.motion_finding(over)
    findings = [
        *([motion] if motion else []),
        judge_frames.jump_finding(over, alone, cuts, flags_of(replace(piece, repair=RepairConfig(skip=tuple(alone))))),
        judge_frames.sharpness_finding(over, blurred, RepairConfig(skip=tuple(blurred)).flags),
        judge_frames.frozen_finding(over, frozen, RepairConfig(skip=tuple(frozen)).flags),
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


def _reader_flags(reader: dict[str, Any]) -> str:
    return " ".join(f"--reader {name}={str(value).lower()}" for name, value in reader.items())


def _readable_finding(sample: Sample, given: RepairConfig) -> Finding:
    tried = len(sample.frames) + len(sample.unreadable)
    ends = max(
        abs(given.pose_shift_frames), abs(given.rgb_shift_frames)
    )  # a shift in time leaves these frames without a pose
    bad = {i: why for i, why in sample.unreadable.items() if ends <= i <= sample.length - 1 - ends}
    numbers = {"tried": float(tried), "unusable": float(len(bad))}
    if not bad:
        return Finding(name="frames", verdict="ok", numbers=numbers, sentence=f"All {tried} frames read are usable.")
    few = len(sample.frames) >= 2 and len(bad) <= tried / 2
    return Finding(
        name="frames",
        verdict="doubtful" if few else "wrong",
        numbers=numbers,
        repair="" if few else "repair the files named here",
        sentence=f"{len(bad)} of {tried} frames cannot be used and are left out of the map, the first because "
        f"{next(iter(bad.values()))}.",
    )


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


def _measured_again(sequence: Sequence, pairs: abc.Sequence[tuple[int, int]], claimed: Alternative) -> Alternative:
    """The same alternative with the values measured on the repaired recording, at positions in it."""
    places = sorted({p for pair in pairs for p in pair})
    sample = read_sample(sequence, at=places)
    there = sample.by_place
    kept = [(a, b) for a, b in pairs if a in there and b in there and b - a > 1]
    if not kept:
        return claimed
    share, median_m = agreeing(FitData.of(sample, kept, RepairConfig()), CalibrationCorrection())
    return replace(claimed, agreeing=share, median_m=median_m)
