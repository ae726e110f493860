"""The explanation that fits depth and poses best: an interpretation of the poses, then corrections."""

import math
from collections import abc
from dataclasses import dataclass, replace

from ...config import RepairConfig
from ...types import Camera
from .confirm import confirmed
from .conventions import DEPTH_FACTORS, PRICE, ScoredInterpretation, best_interpretation
from .corrections import KINDS, AdoptedCorrections, FittedCorrection, correct
from .geometry_fit import CalibrationCorrection, FitData, agreeing
from .sample import Sample

WORTH_TRYING = 0.03
"""Another interpretation is examined further if it scores this much higher than as read. In a clean recording the best
other one scores at least 0.06 lower (0.9 against 0.8 over 30 frames with little motion)."""
_HURDLE = 0.7
"""If another interpretation is likely, corrections of the one as read are examined only if the first removes this much.
"""
SLOWEST_WRONG_STEP_M = 0.7
"""A median step between frames above this is not a hand-held camera: the unit of the positions is wrong."""
PLAUSIBLE_DEPTH_M = (0.15, 20.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Alternative:
    """One alternative that was tried, for the table."""

    what: str
    flags: str
    agreeing: float
    """Share of a frame's points that agree with another frame within 3 per cent."""
    median_m: float
    """Median depth difference, metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Explanation:
    """The best explanation, the alternatives tried, and how well they fit."""

    interpretation: RepairConfig
    """Direction, axes, quaternion order and units."""
    corrected: AdoptedCorrections
    before: Alternative
    after: Alternative
    rows: list[Alternative]
    """Everything tried, best first."""
    data: FitData
    """Data of the pairs under ``interpretation``."""
    tried: list[ScoredInterpretation]
    """The interpretations that were compared, best first."""
    unconfirmed: abc.Mapping[str, abc.Sequence[float]]
    """Corrections that parts of the recording contradict: kind, and what each part gave."""


def explain(sample: Sample, pairs: abc.Sequence[tuple[int, int]]) -> Explanation:
    """Correct the sequence as read and the best other interpretation; return the one that fits better in the end.

    A wrong focal length or time offset can make a wrong interpretation score higher than the right one; only the
    comparison after all corrections shows it.
    """
    tried = best_interpretation(sample, pairs)
    as_read = next(t for t in tried if t.is_as_read)
    others = [t for t in tried if not t.is_as_read and t.worth > as_read.score + WORTH_TRYING][:1]
    far = [p for p in pairs if p[1] - p[0] > 1] or list(pairs)
    followed = []
    for t in (as_read, *others):
        data = FitData.of(sample, far, t.repair)
        corrected = correct(data, hurdle=_HURDLE if others and t is as_read else 1.0)
        share, median_m = agreeing(data, corrected.correction)
        worth = share - PRICE * (len(t.repair.changes) + 2 * len(corrected.adopted))
        followed.append((worth, t.repair, corrected, data, share, median_m))
    _, interpretation, corrected, data, share, median_m = max(followed, key=lambda f: f[0])
    corrected, unconfirmed = confirmed(corrected, sample, far, interpretation)
    if unconfirmed:
        share, median_m = agreeing(data, corrected.correction)
    start = FitData.of(sample, far, RepairConfig())
    before = Alternative(what="as read", flags="", **_numbers(start, CalibrationCorrection()))
    units = with_units(interpretation, sample)
    flags = replace(units, **repair_fields(corrected.correction, sample.camera, units)).flags
    median_m *= units.depth_factor / interpretation.depth_factor
    after = Alternative(what="best explanation", flags=flags, agreeing=share, median_m=median_m)
    return Explanation(
        interpretation=units,
        corrected=corrected,
        before=before,
        after=after,
        data=data,
        tried=tried,
        unconfirmed=unconfirmed,
        rows=_table(sample, far, tried, corrected.last, data, interpretation, before),
    )


def repair_fields(c: CalibrationCorrection, camera: Camera, interpretation: RepairConfig) -> dict:
    """The fields of ``RepairConfig`` that are equivalent to ``c``, rounded to the precision of the measurement."""
    found: dict = {}
    if c.log_scale:
        found["depth_factor"] = snapped(interpretation.depth_factor * math.exp(c.log_scale))
    if c.ray:
        found["depth_kind"] = "ray"
    if c.shift_frames:
        whole = abs(c.shift_frames - round(c.shift_frames)) < 0.1
        found["pose_shift_frames"] = round(c.shift_frames, 0 if whole else 1)
    if c.log_focal or c.log_aspect:
        found["fx"] = round(camera.fx * math.exp(c.log_focal + c.log_aspect), 1)
        found["fy"] = round(camera.fy * math.exp(c.log_focal - c.log_aspect), 1)
        differ = abs(camera.fx / camera.fy - 1) > 0.01
        if differ and abs(found["fx"] / camera.fy - 1) < 0.006 and abs(found["fy"] / camera.fx - 1) < 0.006:
            found |= {"fx": camera.fy, "fy": camera.fx}  # exchanged, so set exactly
    if c.cx_px or c.cy_px:
        half = math.copysign(0.5, c.cx_px)
        if abs(c.cx_px - half) < 0.2 and abs(c.cy_px - half) < 0.2:
            found["pixel_shift"] = half
        else:
            found |= {"cx": max(0.0, round(camera.cx + c.cx_px, 1)), "cy": max(0.0, round(camera.cy + c.cy_px, 1))}
            differ = abs(camera.cx - camera.cy) > 10
            if differ and abs(found["cx"] - camera.cy) < 3 and abs(found["cy"] - camera.cx) < 3:
                found |= {"cx": camera.cy, "cy": camera.cx}
    return found


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
    known = [f.depth_m[f.depth_m > 0].median() for f in sample.frames if bool((f.depth_m > 0).any())]
    depth_m = float(sorted(known)[len(known) // 2])
    steps = (sample.stored_poses[1:, :3, 3] - sample.stored_poses[:-1, :3, 3]).norm(dim=1)
    step_m = float(steps.nanmedian()) if len(steps) else 0.0
    low, high = PLAUSIBLE_DEPTH_M
    if low < depth_m < high and step_m > SLOWEST_WRONG_STEP_M:
        return replace(interpretation, depth_factor=1.0, translation_factor=1 / interpretation.depth_factor)
    return interpretation


def _numbers(data: FitData, c: CalibrationCorrection) -> dict[str, float]:
    share, median_m = agreeing(data, c)
    return {"agreeing": share, "median_m": median_m}


def _table(
    sample: Sample,
    pairs: abc.Sequence[tuple[int, int]],
    tried: list[ScoredInterpretation],
    last: list[FittedCorrection],
    data: FitData,
    interpretation: RepairConfig,
    before: Alternative,
) -> list[Alternative]:
    """As read, the best interpretations, and the best correction of every kind, applied after the adopted
    interpretation."""
    rows = [before]
    for t in [t for t in tried if not t.is_as_read][:8]:
        numbers = _numbers(FitData.of(sample, pairs, t.repair), CalibrationCorrection())
        units = with_units(t.repair, sample)
        numbers["median_m"] *= units.depth_factor / t.repair.depth_factor
        rows.append(Alternative(what="another interpretation", flags=units.flags, **numbers))
    for f in last:
        if f.amount <= KINDS[f.kind].least:
            continue
        fields = repair_fields(f.correction, sample.camera, interpretation)
        if fields:
            rows.append(
                Alternative(what=f.kind, flags=replace(interpretation, **fields).flags, **_numbers(data, f.correction))
            )
    return sorted(rows, key=lambda r: -r.agreeing)
