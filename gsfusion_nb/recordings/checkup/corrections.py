"""Finding small corrections: each kind is fitted alone, the best is adopted, and the search is repeated."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from .geometry_fit import CalibrationCorrection, FitData, cost, median_error

HELPS = 0.95
"""A correction is adopted if it reduces the cost below this share. The largest gain measured on a clean recording, by a
correction larger than ``least``, is 0.99."""
CLEAR = 0.90
"""Below this share of the cost the recording is called wrong, above it doubtful."""
_SIZES = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)
"""Ratios of image sizes, for intrinsics of one size used with images of another."""


@dataclass(frozen=True, kw_only=True)
class CorrectionKind:
    """One kind of correction."""

    fields: tuple[str, ...]
    width: float
    """Half the width of the search range."""
    least: float
    """Smaller corrections also occur in clean recordings."""


KINDS = {
    "depth scale": CorrectionKind(fields=("log_scale",), width=0.5, least=0.012),
    "pose time": CorrectionKind(fields=("shift_frames",), width=4.0, least=0.12),
    "focal length": CorrectionKind(fields=("log_focal",), width=0.5, least=0.01),
    "fx / fy": CorrectionKind(fields=("log_aspect",), width=0.3, least=0.008),
    "principal point": CorrectionKind(fields=("cx_px", "cy_px"), width=60.0, least=0.35),
    "intrinsics size": CorrectionKind(fields=("log_focal", "cx_px", "cy_px"), width=0.0, least=0.0),
    "depth kind": CorrectionKind(fields=("ray",), width=0.0, least=0.0),
}


@dataclass(frozen=True, kw_only=True)
class FittedCorrection:
    """The best correction of one kind."""

    kind: str
    correction: CalibrationCorrection
    """Including the corrections adopted before."""
    amount: float
    """Largest change, in the field's unit."""
    ratio: float
    """Cost with the correction / cost without it; 1 means no gain."""
    uncertainty: float
    """Half the range in which the cost is within 2 per cent of its minimum, in the first field's unit."""


@dataclass(frozen=True, kw_only=True)
class AdoptedCorrections:
    """The corrections adopted, in order, and the fits of the last round."""

    adopted: list[FittedCorrection]
    last: list[FittedCorrection]

    @property
    def correction(self) -> CalibrationCorrection:
        """All corrections together."""
        return self.adopted[-1].correction if self.adopted else CalibrationCorrection()

    def adopted_fit(self, kind: str) -> FittedCorrection | None:
        """The correction of a kind, if it was adopted."""
        return next((f for f in self.adopted if f.kind == kind), None)

    def last_fit(self, kind: str) -> FittedCorrection | None:
        """The fit of a kind in the last round."""
        return next((f for f in self.last if f.kind == kind), None)

    def cost_ratio(self, kind: str) -> float:
        """What a kind of correction, adopted or only tried, leaves of the cost; NaN if it was not tried."""
        fitted = self.adopted_fit(kind) or self.last_fit(kind)
        return fitted.ratio if fitted else math.nan


def correct(data: FitData, *, rounds: int = 3, hurdle: float = 1.0) -> AdoptedCorrections:
    """Adopt the kind of correction with the largest gain until none has any.

    Args:
        data: The pairs.
        rounds: Largest number of corrections.
        hurdle: Continue after the first only if it reduced the cost below this share.
    """
    adopted: list[FittedCorrection] = []
    now = CalibrationCorrection()
    last: list[FittedCorrection] = []
    for _ in range(rounds):
        last = fit_all(data, now)
        helpful = [f for f in last if f.ratio < HELPS and f.amount > KINDS[f.kind].least]
        if not helpful:
            break
        best = min(helpful, key=lambda f: f.ratio)
        adopted.append(best)
        now = best.correction
        if best.ratio > hurdle:
            break
    return AdoptedCorrections(adopted=adopted, last=last)


def fit_all(data: FitData, start: CalibrationCorrection) -> list[FittedCorrection]:
    """The best correction of every kind from ``start``."""
    f = cost_of(data, start)
    before = max(f(start), 1e-6)
    fitted = []
    for name, kind in KINDS.items():
        if name == "depth kind":
            tried = [replace(start, ray=not start.ray)]
        elif name == "intrinsics size":
            tried = [_resized(data, start, k) for k in _SIZES]
        else:
            best, spread = search(f, start, kind, data.thinning * data.camera.width / 640)
            tried = [best]
        if name in ("depth kind", "intrinsics size"):
            best, spread = min(tried, key=f), math.nan
        amount = max(abs(float(getattr(best, x)) - float(getattr(start, x))) for x in kind.fields)
        fitted.append(
            FittedCorrection(kind=name, correction=best, amount=amount, ratio=f(best) / before, uncertainty=spread)
        )
    return fitted


def _resized(data: FitData, c: CalibrationCorrection, k: float) -> CalibrationCorrection:
    """``c`` with all four intrinsics multiplied by ``k``."""
    full = (data.camera.cx * data.thinning, data.camera.cy * data.thinning)
    return replace(
        c, log_focal=c.log_focal + math.log(k), cx_px=c.cx_px + (k - 1) * full[0], cy_px=c.cy_px + (k - 1) * full[1]
    )


def cost_of(data: FitData, start: CalibrationCorrection) -> Callable[[CalibrationCorrection], float]:
    """The cost of a correction; differences are cut at three times their median at ``start`` (0.2 to 6 per cent)."""
    tolerance = min(max(3 * median_error(data, start), 0.002), 0.06)
    return lambda c: cost(data, c, tolerance)


def search(
    f: Callable[[CalibrationCorrection], float], start: CalibrationCorrection, kind: CorrectionKind, pixels: float
) -> tuple[CalibrationCorrection, float]:
    """Minimum of the cost over the fields of ``kind``, one after another, in narrowing rounds; and its width."""
    is_centre = "cx_px" in kind.fields
    width = kind.width * (pixels if is_centre else 1.0)
    best, value = start, f(start)
    seen: list[tuple[float, float]] = []
    for part in (1.0, 0.25, 0.06) if is_centre else (1.0,):
        for name in kind.fields:
            best, value, tried = _line(f, best, value, name, width * part, 3 if is_centre else 4)
            if name == kind.fields[0]:
                seen += tried
    near = [x for x, v in seen if v <= 1.02 * value + 1e-9]
    return best, (max(near) - min(near)) / 2 if near else math.nan


def _line(
    f: Callable[[CalibrationCorrection], float],
    c: CalibrationCorrection,
    value: float,
    name: str,
    width: float,
    levels: int,
) -> tuple[CalibrationCorrection, float, list[tuple[float, float]]]:
    """Try nine values of a field around the best and refine ``levels`` times; returns the best, its cost, and all
    tried."""
    tried = [(getattr(c, name), value)]
    for _ in range(levels):
        for x in getattr(c, name) + width * np.linspace(-1, 1, 9):
            tried.append((float(x), f(replace(c, **{name: float(x)}))))
        x, least = min(tried, key=lambda t: t[1])
        if least < value:
            c, value = replace(c, **{name: x}), least
        width *= 0.3
    return c, value, tried
