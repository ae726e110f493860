"""The explanation that fits depth and poses best: an interpretation of the poses, then corrections
that parts of the recording confirm."""

import itertools
import math
from collections import abc
from dataclasses import dataclass, replace

from ...config import RepairConfig
from ...types import Camera
from .agreement import Agreement, CalibrationCorrection, FitData, agreement
from .fit import KINDS, FittedCorrection, correct, cost_of, search_from_nearest, together
from .interpretations import DEPTH_FACTORS, PRICE, ScoredInterpretation, best_interpretation
from .sample import WINDOW, Sample

WORTH_TRYING = 0.03
"""Another interpretation is examined further if it scores this much higher than as read. In a clean
recording the best other one scores at least 0.06 lower (0.9 against 0.8 over 30 frames with little
motion)."""

SLOWEST_WRONG_STEP_M = 0.7
"""A median step between frames above this is not a hand-held camera: the unit of the positions is
wrong."""

PLAUSIBLE_DEPTH_M = (0.15, 20.0)

_PARTS = 3

_LEAST_PAIRS = 3

_INTRINSICS = ("focal length", "fx / fy", "principal point")
"""What a time offset leaves behind can look like these; in less than a window that cannot be told
apart."""

_AGREE = 0.6
"""A part confirms a correction if its own differs by at most this share of it, or by its own
uncertainty."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Explanation:
    """The best explanation, and how well it fits."""

    interpretation: RepairConfig
    """Direction, axes, quaternion order and units."""
    correction: CalibrationCorrection
    adopted: dict[str, FittedCorrection]
    """The corrections that every part of the recording confirms, by kind."""
    contradicted: frozenset[str]
    """Kinds of corrections that a part of the recording does not confirm."""
    fits: dict[str, FittedCorrection]
    """The last fit of every kind, adopted or only tried."""
    as_read: Agreement
    repaired: Agreement
    data: FitData
    """Data of the pairs under ``interpretation``."""
    tried: list[ScoredInterpretation]
    """The interpretations that were compared, best first."""
    repair: RepairConfig
    """The interpretation and the corrections."""


def explain(sample: Sample, pairs: abc.Sequence[tuple[int, int]]) -> Explanation:
    """Correct the sequence as read and the best other interpretation; return the one that fits
    better in the end.

    A wrong focal length or time offset can make a wrong interpretation score higher than the right
    one; only the comparison after all corrections shows it.
    """
    interpretations = best_interpretation(sample, pairs)
    as_read = next(t for t in interpretations if not t.repair.changes)
    others = [t for t in interpretations if t.worth > as_read.score + WORTH_TRYING][:1]
    distant_pairs = [p for p in pairs if p[1] - p[0] > 1] or list(pairs)
    outcomes = []
    for t in (as_read, *others):
        data = FitData.of(sample, distant_pairs, t.repair)
        fits, last = correct(data)
        share = agreement(data, together(fits)).share
        outcomes.append(
            (
                share - PRICE * (len(t.repair.changes) + 2 * len(fits)),
                t.repair,
                fits,
                last,
                data,
            )
        )
    _, interpretation, fits, last, data = max(outcomes, key=lambda f: f[0])
    contradictions = _contradicted(fits, sample, distant_pairs, interpretation)
    corrections = [f for f in fits if f.kind not in contradictions]
    correction = together(corrections)
    units = with_units(interpretation, sample)
    final_agreement = agreement(data, correction)
    return Explanation(
        interpretation=units,
        correction=correction,
        adopted={f.kind: f for f in corrections},
        contradicted=contradictions,
        fits={f.kind: f for f in (*last, *corrections)},
        as_read=agreement(
            FitData.of(sample, distant_pairs, RepairConfig()), CalibrationCorrection()
        ),
        repaired=final_agreement._replace(
            median_m=final_agreement.median_m * units.depth_factor / interpretation.depth_factor
        ),
        data=data,
        tried=interpretations,
        repair=repair_of(correction, sample.camera, units),
    )


def _contradicted(
    corrections: list[FittedCorrection],
    sample: Sample,
    pairs: abc.Sequence[tuple[int, int]],
    interpretation: RepairConfig,
) -> frozenset[str]:
    """Kinds of corrections that a third of the recording, fitted alone, contradicts, or that fewer
    than two know.

    A wrong focal length or principal point is the same in every part. What rotation, a time offset
    or a rolling shutter do to the depth images changes with the motion, and in one stretch of it a
    wrong intrinsic can imitate it.
    """
    in_order = sorted(pairs, key=sum)
    cuts = [round(k * len(in_order) / _PARTS) for k in range(_PARTS + 1)]
    parts = [in_order[a:b] for a, b in itertools.pairwise(cuts) if b - a >= _LEAST_PAIRS]
    whole = together(corrections)
    kinds = set()
    brief = len(sample.frames) < WINDOW and any(f.kind == "pose time" for f in corrections)
    for one in corrections if len(parts) > 1 else []:
        kind = KINDS[one.kind]
        start = together(f for f in corrections if f is not one)
        if not kind.width:
            continue
        field = max(one.added, key=lambda x: abs(one.added[x]))
        full_value = one.added[field]
        knowing = 0
        agreeing = True
        for data in (FitData.of(sample, part, interpretation) for part in parts):
            cost = cost_of(data, whole)
            best, uncertainty = search_from_nearest(data, cost, start, one.kind)
            best = min(best, whole, key=cost)  # the search may end in another valley
            knowing += uncertainty < abs(full_value)
            value = getattr(best, field) - getattr(start, field)
            agreeing &= abs(value - full_value) <= max(_AGREE * abs(full_value), uncertainty)
        if not agreeing or knowing < 2 or (brief and one.kind in _INTRINSICS):
            kinds.add(one.kind)
    return frozenset(kinds)


_UNEQUAL_FOCAL = 0.01

_SAME_FOCAL = 0.006
"""Focal lengths that differ by more than the first are exchanged, if what is measured differs from
the exchanged ones by less than the second, as shares."""

_UNEQUAL_CENTRE = 10 / 640

_SAME_CENTRE = 3 / 640
"""Likewise cx and cy, as shares of the width."""

_SAME_HALF_PX = 0.2
"""A principal point this close to half a pixel away is one of pixels that are counted otherwise."""


def repair_of(
    c: CalibrationCorrection, camera: Camera, interpretation: RepairConfig
) -> RepairConfig:
    """An interpretation and a correction as the options of a reader, rounded to the precision of
    the measurement."""
    changes: dict = {}
    if c.log_scale:
        changes["depth_factor"] = snapped(interpretation.depth_factor * math.exp(c.log_scale))
    if c.ray:
        changes["depth_kind"] = "ray"
    if c.shift_frames:
        whole = abs(c.shift_frames - round(c.shift_frames)) < 0.1
        changes["pose_shift_frames"] = round(c.shift_frames, 0 if whole else 1)
    if c.log_focal or c.log_aspect:
        changes |= _focal_lengths(c, camera)
    if c.cx_px or c.cy_px:
        changes |= _principal_point(c, camera)
    return replace(interpretation, **changes)


def _focal_lengths(c: CalibrationCorrection, camera: Camera) -> dict[str, float]:
    """The corrected focal lengths; those of the camera if they are only exchanged."""
    fx = round(camera.fx * math.exp(c.log_focal + c.log_aspect), 1)
    fy = round(camera.fy * math.exp(c.log_focal - c.log_aspect), 1)
    differ = abs(camera.fx / camera.fy - 1) > _UNEQUAL_FOCAL
    if differ and max(abs(fx / camera.fy - 1), abs(fy / camera.fx - 1)) < _SAME_FOCAL:
        return {"fx": camera.fy, "fy": camera.fx}
    return {"fx": fx, "fy": fy}


def _principal_point(c: CalibrationCorrection, camera: Camera) -> dict[str, float]:
    """The corrected principal point: a shift by half a pixel, the camera's own with cx and cy
    exchanged, or another one."""
    half = math.copysign(0.5, c.cx_px)
    if max(abs(c.cx_px - half), abs(c.cy_px - half)) < _SAME_HALF_PX:
        return {"pixel_shift": half}
    cx = max(0.0, round(camera.cx + c.cx_px, 1))
    cy = max(0.0, round(camera.cy + c.cy_px, 1))
    differ = abs(camera.cx - camera.cy) > _UNEQUAL_CENTRE * camera.width
    error_px = max(abs(cx - camera.cy), abs(cy - camera.cx))
    if differ and error_px < _SAME_CENTRE * camera.width:
        return {"cx": camera.cy, "cy": camera.cx}
    return {"cx": cx, "cy": cy}


def snapped(factor: float) -> float:
    """The usual depth factor if one is within 1.5 per cent, else the factor with four digits."""
    usual = min(DEPTH_FACTORS, key=lambda f: abs(math.log(factor / f)))
    return usual if abs(math.log(factor / usual)) < 0.015 else float(f"{factor:.4g}")


def with_units(interpretation: RepairConfig, sample: Sample) -> RepairConfig:
    """Applies the factor to depth, or its inverse to the positions if only these are implausible.

    Comparing depth with depth shows only their ratio.
    """
    if interpretation.depth_factor == 1.0 or not sample.frames:
        return interpretation
    medians = [
        f.depth_m[f.depth_m > 0].median() for f in sample.frames if bool((f.depth_m > 0).any())
    ]
    depth_m = float(sorted(medians)[len(medians) // 2])
    steps = (sample.stored_poses[1:, :3, 3] - sample.stored_poses[:-1, :3, 3]).norm(dim=1)
    step_m = float(steps.nanmedian()) if len(steps) else 0.0
    low, high = PLAUSIBLE_DEPTH_M
    if low < depth_m < high and step_m > SLOWEST_WRONG_STEP_M:
        return replace(
            interpretation, depth_factor=1.0, translation_factor=1 / interpretation.depth_factor
        )
    return interpretation
