"""Which small correction makes depth agree best: each kind is fitted alone, the best is adopted, and again."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from .geometry_fit import Correction, FitData, cost, median_error

HELPS = 0.95
"""A correction is adopted if it brings the cost below this share. Of what clean recordings gain by corrections larger
than ``least``, the most measured is 0.99."""
CLEAR = 0.90
"""Below this share the recording is called wrong without it, above it doubtful."""
_SIZES = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)
"""Ratios of image sizes: intrinsics of one used with another."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One kind of correction."""

    fields: tuple[str, ...]
    width: float
    """How far to either side it is searched."""
    least: float
    """Smaller ones are within what a clean recording may show."""


KINDS = {
    "depth scale": Kind(fields=("log_scale",), width=0.5, least=0.012),
    "pose time": Kind(fields=("shift_frames",), width=4.0, least=0.12),
    "focal length": Kind(fields=("log_focal",), width=0.5, least=0.01),
    "fx / fy": Kind(fields=("log_aspect",), width=0.3, least=0.008),
    "principal point": Kind(fields=("cx_px", "cy_px"), width=60.0, least=0.35),
    "intrinsics size": Kind(fields=("log_focal", "cx_px", "cy_px"), width=0.0, least=0.0),
    "depth kind": Kind(fields=("ray",), width=0.0, least=0.0),
}


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """The best correction of one kind."""

    kind: str
    correction: Correction
    """Including what had been adopted before."""
    amount: float
    """Largest change in a field's unit."""
    ratio: float
    """Cost with it / cost without: 1 is no help."""
    uncertainty: float
    """Half the range in which the cost is within 2 per cent of its least, in the first field's unit."""


@dataclass(frozen=True, kw_only=True)
class Corrected:
    """The corrections adopted, in order, and the fits of the last round."""

    adopted: list[Fitted]
    last: list[Fitted]

    @property
    def correction(self) -> Correction:
        """All of them together."""
        return self.adopted[-1].correction if self.adopted else Correction()


def correct(data: FitData, *, rounds: int = 3, hurdle: float = 1.0) -> Corrected:
    """Adopt the kind of correction that helps most until none does.

    Args:
        data: The pairs.
        rounds: Corrections adopted at most.
        hurdle: Go on after the first only if it brought the cost below this share.
    """
    adopted: list[Fitted] = []
    now = Correction()
    last: list[Fitted] = []
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
    return Corrected(adopted=adopted, last=last)


def fit_all(data: FitData, start: Correction) -> list[Fitted]:
    """The best correction of every kind from ``start``.

    Differences count up to three times their median (between 0.2 and 6 per cent of the depth).
    """
    tolerance = min(max(3 * median_error(data, start), 0.002), 0.06)

    def f(c: Correction) -> float:
        return cost(data, c, tolerance)

    before = max(f(start), 1e-6)
    fitted = []
    for name, kind in KINDS.items():
        if name == "depth kind":
            tried = [replace(start, ray=not start.ray)]
        elif name == "intrinsics size":
            tried = [_resized(data, start, k) for k in _SIZES]
        else:
            best, spread = _search(f, start, kind, data.thinning * data.camera.width / 640)
            tried = [best]
        if name in ("depth kind", "intrinsics size"):
            best, spread = min(tried, key=f), math.nan
        amount = max(abs(float(getattr(best, x)) - float(getattr(start, x))) for x in kind.fields)
        fitted.append(Fitted(kind=name, correction=best, amount=amount, ratio=f(best) / before, uncertainty=spread))
    return fitted


def _resized(data: FitData, c: Correction, k: float) -> Correction:
    """``c`` with all four intrinsics multiplied by ``k``."""
    full = (data.camera.cx * data.thinning, data.camera.cy * data.thinning)
    return replace(
        c, log_focal=c.log_focal + math.log(k), cx_px=c.cx_px + (k - 1) * full[0], cy_px=c.cy_px + (k - 1) * full[1]
    )


def _search(f: Callable[[Correction], float], start: Correction, kind: Kind, pixels: float) -> tuple[Correction, float]:
    """Least cost over the fields of ``kind``, one after another, in narrowing rounds; and how sharp the least is."""
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
    f: Callable[[Correction], float], c: Correction, value: float, name: str, width: float, levels: int
) -> tuple[Correction, float, list[tuple[float, float]]]:
    """Nine values of a field about the best, refined ``levels`` times; the best, its cost, and all that was tried."""
    tried = [(getattr(c, name), value)]
    for _ in range(levels):
        for x in getattr(c, name) + width * np.linspace(-1, 1, 9):
            tried.append((float(x), f(replace(c, **{name: float(x)}))))
        x, least = min(tried, key=lambda t: t[1])
        if least < value:
            c, value = replace(c, **{name: x}), least
        width *= 0.3
    return c, value, tried
