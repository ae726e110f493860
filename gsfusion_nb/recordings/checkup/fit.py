"""The search for the corrections of scale, time, focal length and principal point under which depth
images predict each other best: each kind is fitted alone, the best is adopted, and the search is
repeated."""

import math
from collections import abc
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from .agreement import CalibrationCorrection, FitData, median_error, reproject

HELPS = 0.95
"""A correction is adopted if it reduces the cost below this share. The largest gain measured on a
clean recording, by a correction larger than ``least``, is 0.99."""
CLEAR = 0.90
"""Below this share of the cost the recording is called wrong, above it doubtful."""
_SIZES = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)
"""Ratios of image sizes, for intrinsics of one size used with images of another."""


class CorrectionKind(NamedTuple):
    """One kind of correction."""

    fields: tuple[str, ...]
    width: float = 0.0
    """Half the width of the search range; 0 where a few values are tried instead."""
    least: float = 0.0
    """Smaller corrections also occur in clean recordings."""


KINDS = {
    "depth scale": CorrectionKind(("log_scale",), width=0.5, least=0.012),
    "pose time": CorrectionKind(("shift_frames",), width=4.0, least=0.12),
    "focal length": CorrectionKind(("log_focal",), width=0.5, least=0.01),
    "fx / fy": CorrectionKind(("log_aspect",), width=0.3, least=0.008),
    "principal point": CorrectionKind(("cx_px", "cy_px"), width=60.0, least=0.35),
    "intrinsics size": CorrectionKind(("log_focal", "cx_px", "cy_px")),
    "depth kind": CorrectionKind(("ray",)),
}


@dataclass(frozen=True, kw_only=True)
class FittedCorrection:
    """The best correction of one kind."""

    kind: str
    added: dict[str, float]
    """What it adds to the fields of a correction."""
    ratio: float
    """Cost with the correction / cost without it; 1 means no gain."""
    uncertainty: float
    """Half the range in which the cost is within 2 per cent of its minimum, in the first field's
    unit."""


def together(corrections: abc.Iterable[FittedCorrection]) -> CalibrationCorrection:
    """All these corrections in one."""
    c = CalibrationCorrection()
    for f in corrections:
        c = replace(
            c,
            **{name: getattr(c, name) + value for name, value in f.added.items()},
        )
    return c


def correct(
    data: FitData, *, rounds: int = 3
) -> tuple[list[FittedCorrection], list[FittedCorrection]]:
    """Adopt the kind of correction with the largest gain until none has any, or for so many
    ``rounds``.

    Returns:
        The corrections adopted, in order, and the fits of all kinds in the last round.
    """
    corrections: list[FittedCorrection] = []
    last: list[FittedCorrection] = []
    for _ in range(rounds):
        last = _fit_all(data, together(corrections))
        helpful = [
            f
            for f in last
            if f.ratio < HELPS and max(map(abs, f.added.values())) > KINDS[f.kind].least
        ]
        if not helpful:
            break
        corrections.append(min(helpful, key=lambda f: f.ratio))
    return corrections, last


def _fit_all(data: FitData, start: CalibrationCorrection) -> list[FittedCorrection]:
    """The best correction of every kind from ``start``."""
    f = cost_of(data, start)
    start_cost = max(f(start), 1e-6)
    corrections = []
    for name, kind in KINDS.items():
        if kind.width:
            best, uncertainty = search_from_nearest(data, f, start, name)
        else:
            sizes = [_resized(data, start, k) for k in _SIZES]
            best = min(
                [replace(start, ray=1.0 - start.ray)] if name == "depth kind" else sizes, key=f
            )
            uncertainty = math.nan
        change = {x: getattr(best, x) - getattr(start, x) for x in kind.fields}
        corrections.append(
            FittedCorrection(
                kind=name, added=change, ratio=f(best) / start_cost, uncertainty=uncertainty
            )
        )
    return corrections


def _with_exchanged_centre(data: FitData, c: CalibrationCorrection) -> CalibrationCorrection:
    """``c`` with cx and cy exchanged: a mistake of writing, farther away than a search reaches."""
    cx_px = data.camera.cx * data.thinning + c.cx_px
    cy_px = data.camera.cy * data.thinning + c.cy_px
    return replace(c, cx_px=c.cx_px + cy_px - cx_px, cy_px=c.cy_px + cx_px - cy_px)


def _resized(data: FitData, c: CalibrationCorrection, k: float) -> CalibrationCorrection:
    """``c`` with all four intrinsics multiplied by ``k``."""
    full = (data.camera.cx * data.thinning, data.camera.cy * data.thinning)
    return replace(
        c,
        log_focal=c.log_focal + math.log(k),
        cx_px=c.cx_px + (k - 1) * full[0],
        cy_px=c.cy_px + (k - 1) * full[1],
    )


def cost_of(
    data: FitData, start: CalibrationCorrection
) -> Callable[[CalibrationCorrection], float]:
    """The cost of a correction: mean of min(|residual| / tolerance, 1) over the points that fall on
    a valid depth, 1 if none does; the tolerance is three times their median at ``start``, 0.2 to 6
    per cent."""
    tolerance = min(max(3 * median_error(data, start), 0.002), 0.06)

    def cost(c: CalibrationCorrection) -> float:
        _, residual, is_measured = reproject(data, c)
        each = (residual.abs() / tolerance).clamp(max=1.0) * is_measured
        return (float(each.sum()) + 1e-9) / (float(is_measured.sum()) + 1e-9)

    return cost


def search_from_nearest(
    data: FitData,
    f: Callable[[CalibrationCorrection], float],
    start: CalibrationCorrection,
    name: str,
) -> tuple[CalibrationCorrection, float]:
    """``search`` for a kind with a range; for the principal point it begins where cx and cy are
    exchanged, if the cost is smaller there."""
    if name == "principal point":
        start = min(start, _with_exchanged_centre(data, start), key=f)
    return search(f, start, KINDS[name], data.thinning * data.camera.width / 640)


def search(
    f: Callable[[CalibrationCorrection], float],
    start: CalibrationCorrection,
    kind: CorrectionKind,
    pixels: float,
) -> tuple[CalibrationCorrection, float]:
    """Minimum of the cost over the fields of ``kind``, one after another, in narrowing rounds; and
    its width."""
    is_centre = "cx_px" in kind.fields
    width = kind.width * (pixels if is_centre else 1.0)
    best = start
    value = f(start)
    trials: list[tuple[float, float]] = []
    for part in (1.0, 0.25, 0.06) if is_centre else (1.0,):
        for name in kind.fields:
            best, value, new_trials = _line(
                f,
                best,
                value,
                name,
                width * part,
                3 if is_centre else 4,
            )
            if name == kind.fields[0]:
                trials += new_trials
    near_best = [x for x, v in trials if v <= 1.02 * value + 1e-9]
    return best, (max(near_best) - min(near_best)) / 2 if near_best else math.nan


def _line(
    f: Callable[[CalibrationCorrection], float],
    c: CalibrationCorrection,
    value: float,
    name: str,
    width: float,
    levels: int,
) -> tuple[CalibrationCorrection, float, list[tuple[float, float]]]:
    """Try nine values of a field around the best and refine ``levels`` times; returns the best, its
    cost, and all tried."""
    trials = [(getattr(c, name), value)]
    for _ in range(levels):
        for x in getattr(c, name) + width * np.linspace(-1, 1, 9):
            trials.append((float(x), f(replace(c, **{name: float(x)}))))
        x, least = min(trials, key=lambda t: t[1])
        if least < value:
            c = replace(c, **{name: x})
            value = least
        width *= 0.3
    return c, value, trials
