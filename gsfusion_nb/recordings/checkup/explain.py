"""The explanation that fits depth and poses best: an interpretation of the poses, then corrections that parts of the
recording confirm.
"""

import itertools
import math
from collections import abc
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...config import RepairConfig
from ...config.parts import AXES, NAMED_AXES
from ...data.adjust.depth_agreement import depth_consistency, depth_pair, relative_under
from ...data.adjust.poses import axis_matrix
from ...types import Camera
from .fit import (
    KINDS,
    AdoptedCorrections,
    Agreement,
    CalibrationCorrection,
    CorrectionKind,
    FitData,
    agreement,
    correct,
    cost_of,
    search,
)
from .sample import WINDOW, Sample

GAPS = (1, 2, 4, 8, 16, 30)
"""Distances in frames between the two of a pair: near frames overlap in any recording, far ones show small errors."""
PAIRS_PER_GAP = 6
DEPTH_FACTORS = (
    0.2, 5.0, 0.1, 10.0, 0.01, 100.0, 0.001, 1000.0, 1000 / 6553.5, 6.5535, 5 / 6.5535, 6.5535 / 5, 0.25, 4.0,
)  # fmt: skip
"""Ratios between the scales of public data sets, of metres, centimetres and millimetres, of 5000 and 6553.5, and of
sensors that store quarter millimetres."""
PRICE = 0.01
"""Required gain in score for each change; of two that fit equally well the simpler interpretation is chosen."""

_ROUGH_POINTS, _FINE_POINTS = 120, 800
_ROUGH_PAIRS = 10
_KEPT = 30
_POSES_AT_ONCE = 512


Interpretation = tuple[RepairConfig, float]
"""An interpretation of the poses (direction, axes, quaternion order), and a factor on depth."""


class ScoredInterpretation(NamedTuple):
    """One interpretation and how well the depth images agree with it, as mean over the pairs."""

    poses: RepairConfig
    depth_factor: float
    score: float
    """0..1; see ``DepthConsistency.score``."""

    @property
    def worth(self) -> float:
        """Score minus the required gain of the changes."""
        return self.score - PRICE * (len(self.poses.changes) + (self.depth_factor != 1.0))

    @property
    def is_as_read(self) -> bool:
        """Whether it changes nothing."""
        return self.depth_factor == 1.0 and not self.poses.changes

    @property
    def repair(self) -> RepairConfig:
        """The same as a correction."""
        return replace(self.poses, depth_factor=self.depth_factor)


def pairs_of(sample: Sample) -> list[tuple[int, int]]:
    """Positions of the frames to compare: for each distance a few pairs, spread over the frames read."""
    found = []
    there = sample.by_place
    for gap in GAPS:
        firsts = [f.place for f in sample.frames if f.place + gap in there]
        if firsts:
            chosen = np.linspace(0, len(firsts) - 1, min(PAIRS_PER_GAP, len(firsts))).round().astype(int)
            found += [(firsts[i], firsts[i] + gap) for i in sorted(set(chosen.tolist()))]
    return found


def _scored(
    sample: Sample, pairs: abc.Sequence[tuple[int, int]], interpretations: abc.Sequence[Interpretation], points: int
) -> list[ScoredInterpretation]:
    """Score each interpretation on the pairs, with about ``points`` points of each; same order."""
    there, camera = sample.by_place, sample.depth_camera
    T_a = torch.stack([there[a].T_stored for a, _ in pairs])
    T_b = torch.stack([there[b].T_stored for _, b in pairs])
    relative = _relatives(T_a, T_b, interpretations)
    step = max(1, round(math.sqrt(camera.width * camera.height / points)))
    scores = []
    for i, (a, b) in enumerate(pairs):
        pair = depth_pair(there[a].depth_m, there[b].depth_m, camera, step=step)
        parts = relative[:, i].split(_POSES_AT_ONCE)
        scores.append(torch.cat([depth_consistency(pair, T_ba).score for T_ba in parts]))
    mean = torch.stack(scores).mean(0).tolist()
    return [ScoredInterpretation(*i, score) for i, score in zip(interpretations, mean, strict=True)]


def best_interpretation(sample: Sample, pairs: abc.Sequence[tuple[int, int]]) -> list[ScoredInterpretation]:
    """Score all pose conventions with all depth scales on few points, and the best ones again on more; best first."""
    poses = [
        RepairConfig(quaternions=q, poses=p, axes=a)
        for q, p, a in itertools.product(
            ("as_read", "wxyz", "xyzw"), ("camera_to_world", "world_to_camera", "rotation_inverted"), _axes()
        )
    ]
    interpretations = [(r, f) for r in poses for f in (1.0, *DEPTH_FACTORS)]
    middle = [pairs[i] for i in sorted({int(i) for i in np.linspace(0, len(pairs) - 1, _ROUGH_PAIRS).round()})]
    rough = sorted(_scored(sample, middle, interpretations, _ROUGH_POINTS), key=lambda t: -t.worth)
    kept = [(t.poses, t.depth_factor) for t in rough[:_KEPT] if not t.is_as_read]
    as_read = (RepairConfig(), 1.0)
    return sorted(_scored(sample, pairs, [as_read, *kept], _FINE_POINTS), key=lambda t: -t.worth)


def _axes() -> list[str]:
    names = {words: name for name, words in NAMED_AXES.items()}
    return [names.get(words, words) for words in AXES]


def _relatives(
    T_a: Float[Tensor, "P 4 4"], T_b: Float[Tensor, "P 4 4"], interpretations: abc.Sequence[Interpretation]
) -> Float[Tensor, "K P 4 4"]:
    """Relative poses under every interpretation; those that differ only in axes and depth factor are computed once."""
    known: dict[tuple[str, str], Float[Tensor, "P 4 4"]] = {}
    axes: dict[str, Float[Tensor, "4 4"]] = {}
    for poses, _ in interpretations:
        key = (poses.quaternions, poses.poses)
        if key not in known:
            known[key] = relative_under(T_a, T_b, replace(poses, axes="opencv"))
        if poses.axes not in axes:
            axes[poses.axes] = axis_matrix(poses)
    M = torch.stack([axes[poses.axes] for poses, _ in interpretations])[:, None]
    relative = M @ torch.stack([known[(p.quaternions, p.poses)] for p, _ in interpretations]) @ M.transpose(2, 3)
    relative[..., :3, 3] /= torch.tensor([f for _, f in interpretations], dtype=relative.dtype)[:, None, None]
    return relative


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
class Explanation:
    """The best explanation, and how well it fits."""

    interpretation: RepairConfig
    """Direction, axes, quaternion order and units."""
    corrected: AdoptedCorrections
    as_read: Agreement
    repaired: Agreement
    data: FitData
    """Data of the pairs under ``interpretation``."""
    tried: list[ScoredInterpretation]
    """The interpretations that were compared, best first."""
    unconfirmed: abc.Mapping[str, abc.Sequence[float]]
    """Corrections that parts of the recording contradict: kind, and what each part gave."""

    def fields(self, camera: Camera) -> dict:
        """The fields of ``RepairConfig`` that are equivalent to the corrections."""
        return repair_fields(self.corrected.correction, camera, self.interpretation)


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
        share = agreement(data, corrected.correction).share
        worth = share - PRICE * (len(t.repair.changes) + 2 * len(corrected.adopted))
        followed.append((worth, t.repair, corrected, data))
    _, interpretation, corrected, data = max(followed, key=lambda f: f[0])
    corrected, unconfirmed = confirmed(corrected, sample, far, interpretation)
    repaired, units = agreement(data, corrected.correction), with_units(interpretation, sample)
    return Explanation(
        interpretation=units,
        corrected=corrected,
        as_read=agreement(FitData.of(sample, far, RepairConfig()), CalibrationCorrection()),
        repaired=repaired._replace(median_m=repaired.median_m * units.depth_factor / interpretation.depth_factor),
        data=data,
        tried=tried,
        unconfirmed=unconfirmed,
    )


def repair_fields(c: CalibrationCorrection, camera: Camera, interpretation: RepairConfig) -> dict:
    """The fields of ``RepairConfig`` that are equivalent to ``c``, rounded to the precision of the measurement; values
    that are exchanged are set exactly."""
    found: dict = {}
    if c.log_scale:
        found["depth_factor"] = snapped(interpretation.depth_factor * math.exp(c.log_scale))
    if c.ray:
        found["depth_kind"] = "ray"
    if c.shift_frames:
        whole = abs(c.shift_frames - round(c.shift_frames)) < 0.1
        found["pose_shift_frames"] = round(c.shift_frames, 0 if whole else 1)
    if c.log_focal or c.log_aspect:
        fx = round(camera.fx * math.exp(c.log_focal + c.log_aspect), 1)
        fy = round(camera.fy * math.exp(c.log_focal - c.log_aspect), 1)
        exchanged = abs(camera.fx / camera.fy - 1) > 0.01
        exchanged &= abs(fx / camera.fy - 1) < 0.006 and abs(fy / camera.fx - 1) < 0.006
        found |= {"fx": camera.fy, "fy": camera.fx} if exchanged else {"fx": fx, "fy": fy}
    if c.cx_px or c.cy_px:
        half = math.copysign(0.5, c.cx_px)
        if abs(c.cx_px - half) < 0.2 and abs(c.cy_px - half) < 0.2:
            return found | {"pixel_shift": half}
        cx, cy = max(0.0, round(camera.cx + c.cx_px, 1)), max(0.0, round(camera.cy + c.cy_px, 1))
        exchanged = abs(camera.cx - camera.cy) > 10 and abs(cx - camera.cy) < 3 and abs(cy - camera.cx) < 3
        found |= {"cx": camera.cy, "cy": camera.cx} if exchanged else {"cx": cx, "cy": cy}
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


_PARTS = 3
_LEAST_PAIRS = 3
_INTRINSICS = ("focal length", "fx / fy", "principal point")
"""What a time offset leaves behind can look like these; in less than a window that cannot be told apart."""
_AGREE = 0.6
"""A part confirms a correction if its own differs by at most this share of it, or by its own uncertainty."""


def confirmed(
    corrected: AdoptedCorrections, sample: Sample, pairs: abc.Sequence[tuple[int, int]], repair: RepairConfig
) -> tuple[AdoptedCorrections, dict[str, list[float]]]:
    """The corrections without those that parts of the recording contradict; and what each part gave for these.

    A wrong focal length or principal point is the same in every part. What rotation, a time offset or a rolling shutter
    do to the depth images changes with the motion, and in one stretch of it a wrong intrinsic can imitate it.

    Args:
        corrected: Fitted to all pairs.
        sample: The frames read.
        pairs: Positions of the frames compared.
        repair: The interpretation under which ``corrected`` was fitted.

    Returns:
        Corrections, and by kind the values of the kind's first changed field, one per part.
    """
    ordered = sorted(pairs, key=sum)
    cuts = [round(k * len(ordered) / _PARTS) for k in range(_PARTS + 1)]
    parts = [ordered[a:b] for a, b in itertools.pairwise(cuts) if b - a >= _LEAST_PAIRS]
    doubts: dict[str, list[float]] = {}
    kept, taken_back, before = [], {}, CalibrationCorrection()
    brief = len(sample.frames) < WINDOW and corrected.adopted_fit("pose time") is not None
    for fitted in corrected.adopted:
        kind = KINDS[fitted.kind]
        added = {x: float(getattr(fitted.correction, x) - getattr(before, x)) for x in kind.fields}
        before, sure, values = fitted.correction, True, []
        if kind.width and len(parts) > 1:
            values, sure = _of_parts(corrected, kind, added, [FitData.of(sample, part, repair) for part in parts])
        if sure and not (values and brief and fitted.kind in _INTRINSICS):
            kept.append(replace(fitted, correction=_without(fitted.correction, taken_back)))
            continue
        doubts[fitted.kind] = values
        taken_back |= {x: taken_back.get(x, 0.0) + value for x, value in added.items()}
    return AdoptedCorrections(adopted=kept, last=corrected.last), doubts


def _without(c: CalibrationCorrection, added: abc.Mapping[str, float]) -> CalibrationCorrection:
    """``c`` without a part of it: another correction may have changed the same fields."""
    return replace(c, **{field: getattr(c, field) - value for field, value in added.items()})


def _of_parts(
    corrected: AdoptedCorrections, kind: CorrectionKind, added: abc.Mapping[str, float], parts: list[FitData]
) -> tuple[list[float], bool]:
    """What each part adds to the other corrections, and whether at least two know it and none contradicts."""
    whole = corrected.correction
    start = _without(whole, added)
    field = max(added, key=lambda x: abs(added[x]))
    wanted = added[field]
    values, knowing, agreeing = [], 0, True
    for data in parts:
        cost = cost_of(data, whole)
        best, spread = search(cost, start, kind, data.thinning * data.camera.width / 640)
        if cost(whole) < cost(best):  # the search ended in another valley
            best = whole
        values.append(float(getattr(best, field) - getattr(start, field)))
        knowing += spread < abs(wanted)
        agreeing &= abs(values[-1] - wanted) <= max(_AGREE * abs(wanted), spread)
    return values, agreeing and knowing >= 2
