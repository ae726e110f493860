"""Whether a correction that the whole recording suggests is also what its parts suggest.

A wrong focal length or principal point is the same in every part. What rotation, a time offset or a rolling shutter do
to the depth images changes with the motion, and in one stretch of it a wrong intrinsic can imitate it.
"""

import itertools
from collections import abc
from dataclasses import replace

from ...config import RepairConfig
from .corrections import KINDS, AdoptedCorrections, CorrectionKind, cost_of, search
from .geometry_fit import CalibrationCorrection, FitData
from .sample import WINDOW, Sample

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
