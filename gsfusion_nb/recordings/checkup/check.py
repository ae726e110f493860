"""The check-up of a recording: read frames, examine each property, try the alternatives, combine
the repairs."""

import time
from collections import abc
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...config import DataConfig, RepairConfig
from ...data.adjust.repair import as_read
from ...data.adjust.selection import apply_options
from ...data.open import detect_layout, known_layouts, open_sequence
from ...data.recorded.decoded_images import DecodedImages
from ...data.recorded.recorded_sequence import RecordedSequence
from ...data.sequence import Sequence
from ...drawing.page import PageGraph
from .agreement import CalibrationCorrection, FitData
from .colour import fit_colour
from .explain import explain
from .frames import (
    exposure_finding,
    gains,
    graphs_of,
    image_findings,
    jump_finding,
    measure_over_frames,
)
from .interpretations import pairs_of
from .judge_colour import registration_findings, unrelated_pictures
from .judge_fit import agreement_finding, fit_findings
from .pictures import path_from_above, pictures_of
from .report import CheckupReport, Finding, flags_of, reader_flags
from .sample import Sample, read_sample
from .stored_values import clear_codes, examine_files, missing_finding, unit_finding
from .trial import Trials, combined

_DECODED_BYTES = 1 << 29
"""Every trial of a repair reads the frames again: 250 of 640 x 480 pixels are decoded once."""


def check_recording(
    sequence_or_path: str | Path | Sequence,
    *,
    data: DataConfig | None = None,
    frames: int = 250,
    pictures: bool = True,
    **reader_options: Any,
) -> CheckupReport:
    """Examine a recording: units, conventions, intrinsics, registration, times, images; and find
    the options that repair it.

    A property with alternatives is tried with all of them. The report names the alternative under
    which the depth images predict each other best (reprojection from frame to frame), and the
    options of ``gsfusion-nb map`` that select it.

    Args:
        sequence_or_path: Folder of a recording, "room", or any ``Sequence``.
        data: Range, depth limits and corrections to start from, for example those of an earlier
            report. Held-out frames are examined too, but no repair is estimated from them.
        frames: Approximate number of frames to read; a longer recording is read in windows of 31
            consecutive frames.
        pictures: Also make the pictures of the page.
        reader_options: For ``open_sequence``: ``format``, options of the reader.

    Raises:
        SequenceError: the recording cannot be opened; the message says why.
    """
    start_time = time.perf_counter()
    initial = data or DataConfig()
    image_store = DecodedImages(_DECODED_BYTES)
    base, hint = _opened(sequence_or_path, reader_options, image_store)
    raw, findings = (
        examine_files(base, initial.repair)
        if isinstance(base, RecordedSequence)
        else (RepairConfig(), [])
    )
    initial = combined(initial, DataConfig(repair=raw))
    trials = Trials(base, initial)
    sequence = apply_options(base, replace(initial, hold_out_every=0))
    sample = read_sample(sequence, frames=frames)
    pairs = pairs_of(trials.mapped(sample))
    has_poses = getattr(base, "has_poses", True)
    layout_options = {name: value for name, value in reader_options.items() if name != "format"}
    report = CheckupReport(
        name=sample.name,
        length=sample.length,
        frames_read=len(sample.frames),
        findings=[_readable_finding(sample, initial.repair), *findings],
        data=initial,
        reader=layout_options,
    )
    if not pairs:
        return report

    trials.pairs = [(sequence.positions[a], sequence.positions[b]) for a, b in pairs]
    new_findings, more, reader, graphs = _examine(sample, pairs, hint, has_poses, trials)
    registered_base = None
    if reader:
        registered_base, _ = _opened(sequence_or_path, {**reader_options, **reader}, image_store)
    new_findings, more, joint_gain = (
        trials.judged(new_findings, more, registered_base)
        if has_poses
        else (new_findings, more, "")
    )
    reader = reader if any(f.repair == reader_flags(reader) for f in new_findings) else {}
    final_data = combined(initial, more)
    repaired_sequence = (
        apply_options(base, replace(final_data, hold_out_every=0))
        if more != DataConfig() and has_poses
        else None
    )
    return replace(
        report,
        findings=[*report.findings, *new_findings],
        data=final_data,
        reader=layout_options | reader,
        together=joint_gain,
        pictures=pictures_of(sequence, repaired_sequence, pairs, has_poses=has_poses)
        if pictures
        else {},
        graphs=graphs if pictures else [],
        seconds=time.perf_counter() - start_time,
    )


def _examine(
    sample: Sample,
    pairs: abc.Sequence[tuple[int, int]],
    hint: dict[str, Any],
    has_poses: bool,
    trials: Trials,
) -> tuple[list[Finding], DataConfig, dict[str, Any], list[PageGraph]]:
    """All findings that come from the frames read; without poses (``has_poses`` False) those on the
    images alone.

    Returns:
        The findings, the repairs that are added to those the recording was read with, the options
        of the reader that repair it, and the graphs.
    """
    codes, code_finding = clear_codes(sample.frames, getattr(trials.base, "depth_scale", None))
    if has_poses:
        e = explain(trials.mapped(sample), pairs)
        first = agreement_finding(e)
        e, sample = trials.in_time(e, sample)
        repair = e.repair
        graphs = path_from_above(sample, e.interpretation)
        lens = getattr(getattr(trials.base, "rectification", None), "lens", None)
        about = fit_findings(e, sample.camera, lens and lens.camera)
        measures = measure_over_frames(sample, e.interpretation, e.correction)
        piece, jumps = jump_finding(
            measures,
            1 + max(int(measures.number.max()), sample.length - 1),
        )
        last = [jumps]
        graphs += graphs_of(measures)
    else:
        repair, unit = unit_finding(trials.mapped(sample), trials.base)
        graphs = []
        piece = DataConfig()
        last = []
        about = [unit]
        text = "The recording has no poses: whatever needs them is not judged."
        first = Finding(
            "poses", "unknown", text, repair="--tracking.poses tracked --reader poses=false"
        )
        measures = measure_over_frames(
            sample, RepairConfig(), CalibrationCorrection(), has_poses=False
        )
    colour, colour_findings = registration_findings(
        fit_colour(trials.mapped(sample)), sample.camera
    )
    if has_poses and colour_findings[0].verdict != "wrong" and not e.interpretation.changes:
        unrelated = unrelated_pictures(trials.mapped(sample), colour.rgb_shift_frames)
        if unrelated:
            colour = RepairConfig()
            colour_findings = [unrelated]
    colour_fits_depth = colour_findings[0].verdict != "wrong" or bool(colour.changes)
    reader = {}
    if hint and colour_findings[0].verdict in (
        "doubtful",
        "wrong",
    ):  # a calibration is better than a shift
        colour = RepairConfig()
        reader = hint
        colour_fits_depth = True
        colour_findings[0] = replace(colour_findings[0], repair=reader_flags(hint))
    if has_poses and colour_fits_depth:
        pairs = [pair for pair in pairs if sample.by_place.keys() >= {*pair}]
        distant_pairs = [(a, b) for a, b in pairs if b - a > 1] or list(pairs)
        data = FitData.of(sample, distant_pairs, e.interpretation)
        last.append(exposure_finding(measures, gains(sample, distant_pairs, data, e.correction)[0]))
    skip, images = image_findings(measures, has_poses=has_poses)
    limits = DataConfig()
    for value_m, high in codes:  # exclude the codes, after the depth factor
        name, factor = ("depth_max_m", 0.99) if high else ("depth_min_m", 1.01)
        limits = replace(limits, **{name: round(factor * value_m * repair.depth_factor, 4)})
    code_finding = replace(code_finding, repair=flags_of(limits))
    data = combined(DataConfig(repair=repair), DataConfig(repair=colour))
    data = combined(
        combined(data, limits), combined(piece, DataConfig(repair=RepairConfig(skip=skip)))
    )
    coverage = missing_finding(sample.frames, repair.depth_factor)
    findings = [first, coverage, code_finding, *about, *colour_findings, *images, *last]
    return findings, data, reader, graphs


def _opened(
    sequence_or_path: str | Path | Sequence,
    reader_options: dict[str, Any],
    image_store: DecodedImages,
) -> tuple[Sequence, dict[str, Any]]:
    """The sequence as its reader returns it, with images held in ``image_store``, and the option of
    the reader that registers colour to depth."""
    if not isinstance(sequence_or_path, (str, Path)):
        return _holding(sequence_or_path, image_store), {}
    source = _holding(
        as_read(open_sequence(sequence_or_path, **reader_options).source), image_store
    )
    layout = reader_options.get("format", "auto")
    if layout == "auto" and isinstance(source, RecordedSequence):
        layout = detect_layout(Path(sequence_or_path).expanduser())
    registration = known_layouts()[layout].registration if layout in known_layouts() else {}
    return source, {} if any(reader_options.get(name) for name in registration) else dict(
        registration
    )


def _holding(source: Sequence, image_store: DecodedImages) -> Sequence:
    return replace(source, decoded=image_store) if isinstance(source, RecordedSequence) else source


def _readable_finding(sample: Sample, initial: RepairConfig) -> Finding:
    n_tried = len(sample.frames) + len(sample.unreadable)
    # a shift in time leaves these frames without a pose
    ends = max(
        abs(initial.pose_shift_frames),
        abs(initial.rgb_shift_frames),
        bool(initial.pose_offset_s or initial.depth_offset_s),
    )
    bad = {i: why for i, why in sample.unreadable.items() if ends <= i <= sample.length - 1 - ends}
    if not bad:
        return Finding("frames", "ok", f"All {n_tried} frames read are usable.")
    text = (
        f"{len(bad)} of {n_tried} frames cannot be used and are left out of the map, the first "
        "because "
    )
    text += f"{next(iter(bad.values()))}."
    if len(sample.frames) >= 2 and len(bad) <= n_tried / 2:
        return Finding("frames", "doubtful", text)
    return Finding("frames", "wrong", text, "repair the files named here")
