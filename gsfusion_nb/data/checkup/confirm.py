"""Whether a correction that the whole recording suggests is also what its parts suggest.

A wrong focal length or principal point is the same in every part. What rotation, a time offset or a rolling shutter do
to the depth images changes with the motion, and in one stretch of it a wrong intrinsic can imitate it.
"""

import itertools
from collections import abc
from dataclasses import replace

from ...config import RepairConfig
from .corrections import KINDS, AdoptedCorrections, cost_of, search
from .geometry_fit import FitData
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
    brief = len(sample.frames) < WINDOW and corrected.adopted_fit("pose time") is not None
    for fitted in corrected.adopted:
        kind = KINDS[fitted.kind]
        if kind.width and len(parts) > 1:
            values, certain = _of_parts(corrected, fitted.kind, [FitData.of(sample, part, repair) for part in parts])
            if not certain or (brief and fitted.kind in _INTRINSICS):
                doubts[fitted.kind] = values
    kept = [f for f in corrected.adopted if f.kind not in doubts]
    if not doubts:
        return corrected, {}
    none = {field: 0.0 for kind in doubts for field in KINDS[kind].fields}
    if any(f.kind == "intrinsics size" for f in kept):  # has the same fields
        none = {field: value for field, value in none.items() if field not in KINDS["intrinsics size"].fields}
    adopted = [replace(f, correction=replace(f.correction, **none)) for f in kept]
    return AdoptedCorrections(adopted=adopted, last=corrected.last), doubts


def _of_parts(corrected: AdoptedCorrections, name: str, parts: list[FitData]) -> tuple[list[float], bool]:
    """The value that each part gives, and whether at least two of them know it and none contradicts."""
    kind, whole = KINDS[name], corrected.correction
    field = max(kind.fields, key=lambda x: abs(getattr(whole, x)))
    wanted = getattr(whole, field)
    values, knowing, agreeing = [], 0, True
    for data in parts:
        start = replace(whole, **dict.fromkeys(kind.fields, 0.0))
        best, spread = search(cost_of(data, whole), start, kind, data.thinning * data.camera.width / 640)
        values.append(float(getattr(best, field)))
        knowing += spread < abs(wanted)
        agreeing &= abs(values[-1] - wanted) <= max(_AGREE * abs(wanted), spread)
    return values, agreeing and knowing >= 2
