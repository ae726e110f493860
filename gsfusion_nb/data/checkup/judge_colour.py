"""Findings on the position of the colour images relative to the depth images, in space and in time."""

import math
from dataclasses import replace

from ...config import RepairConfig
from ...types import Camera
from .alignment import ColourFit
from .findings import Finding

SHIFT_LIMITS = ((3.0, 1.2), (5.0, 2.0))
"""Shifts from which a recording is doubtful and wrong, in 640ths of the image width, and in compared pixels (the larger
counts). Registered Kinects measure up to 2: their depth edges are ragged."""
SCALE_DOUBTFUL = 0.015
"""Registered recordings measure 0 to 0.005."""
_CLEAR_PEAK = 5.0
"""Smallest peak, in standard deviations, that counts as a shift; real ones have 6 and more."""
_IN_ORDER = 0.5
"""Share of frames whose most similar colour image is a neighbour in time: 0.99 to 1 in order, 0 shuffled."""
_UNRELATED_PEAK, _UNRELATED_SCORE = 5.0, 0.4
"""Below both, colour has no edges on the depth edges under any shift: wrongly paired frames give up to 4 and 0.2,
registered ones 6 to 10 and 0.9 to 1.4."""


def registration_findings(
    fit: ColourFit | None, camera: Camera, order: float | None
) -> tuple[RepairConfig, list[Finding]]:
    """Findings on the position of colour relative to depth, in space and in time.

    Args:
        fit: Result of ``fit_colour``.
        camera: Camera of the full images.
        order: Result of ``in_order``.
    """
    mixed = order is not None and order < _IN_ORDER
    if fit is None and mixed:
        return RepairConfig(), [_mixed_up({"in_order": order or 0.0})]
    if fit is None:
        text = "Too few depth edges to compare with colour."
        return RepairConfig(), [
            Finding(name="registration", verdict="ok", sentence=text),
            Finding(name="colour time", verdict="ok", sentence=text),
        ]
    numbers = {
        "shift_x_px": fit.shift_px[0],
        "shift_y_px": fit.shift_px[1],
        "scale": fit.scale,
        "contrast_on_edges": fit.score,
        "contrast_as_read": fit.score_as_read,
        "peak": fit.peak,
    }
    if mixed or (fit.score < _UNRELATED_SCORE and fit.peak < _UNRELATED_PEAK):
        return RepairConfig(), [_mixed_up(numbers)]
    shift = math.hypot(*fit.shift_px)
    together = f"Colour edges lie on depth edges within {shift:.1f} pixels."
    unclear = "The edges of colour and depth are too few or too similar to compare."
    space = Finding(
        name="registration", verdict="ok", numbers=numbers, sentence=together if fit.peak >= _CLEAR_PEAK else unclear
    )
    repair, time = _time_finding(fit)
    if fit.shift_frames:
        return repair, [space, time]
    doubtful, wrong_from = (max(limit * camera.width / 640, pixels * fit.pixel) for limit, pixels in SHIFT_LIMITS)
    zoomed = abs(fit.scale - 1) > SCALE_DOUBTFUL
    if fit.peak < _CLEAR_PEAK or (fit.mirror == "none" and shift < doubtful and not zoomed):
        return RepairConfig(), [space, time]
    repair, text = _registration_repair(fit, shift >= doubtful)
    wrong = fit.mirror != "none" or shift >= wrong_from or zoomed
    verdict = "wrong" if wrong else "doubtful"
    return repair, [replace(space, verdict=verdict, sentence=text, repair=repair.flags), time]


def _time_finding(fit: ColourFit) -> tuple[RepairConfig, Finding]:
    """Were colour and depth taken at the same time?"""
    if not fit.shift_frames:
        return RepairConfig(), Finding(
            name="colour time",
            verdict="ok",
            numbers={"shift_frames": 0.0},
            sentence="Colour and depth were taken at the same time.",
        )
    repair = RepairConfig(rgb_shift_frames=fit.shift_frames)
    side = "later" if fit.shift_frames > 0 else "earlier"
    return repair, Finding(
        name="colour time",
        verdict="wrong",
        numbers={"shift_frames": float(fit.shift_frames)},
        repair=repair.flags,
        sentence=f"A frame's depth image belongs to the colour image recorded {abs(fit.shift_frames)} frames {side}.",
    )


def _mixed_up(numbers: dict[str, float]) -> Finding:
    return Finding(
        name="registration",
        verdict="wrong",
        numbers=numbers,
        repair="pair every depth image with the colour image of its time (names, order, association)",
        sentence="The colour images do not belong to the depth images: their order or their edges do not fit.",
    )


def _registration_repair(fit: ColourFit, shifted: bool) -> tuple[RepairConfig, str]:
    moved = shifted or abs(fit.scale - 1) > SCALE_DOUBTFUL
    repair = RepairConfig(
        rgb_mirror=fit.mirror,  # pyright: ignore[reportArgumentType]
        rgb_shift_x_px=round(fit.shift_px[0], 1) if moved else 0.0,
        rgb_shift_y_px=round(fit.shift_px[1], 1) if moved else 0.0,
        rgb_scale=fit.scale if abs(fit.scale - 1) > SCALE_DOUBTFUL else 1.0,
    )
    words = []
    if fit.mirror != "none":
        words.append({"x": "mirrored left to right", "y": "upside down", "xy": "rotated by 180 degrees"}[fit.mirror])
    if repair.rgb_scale != 1:
        words.append(f"{fit.scale:.2f} times as large")
    if moved:
        x, y = fit.shift_px
        words.append(
            f"shifted by {abs(x):.1f} pixels to the {'right' if x > 0 else 'left'} and {abs(y):.1f} "
            f"{'down' if y > 0 else 'up'}"
        )
    note = "; a reader that registers depth with a calibration is better" if repair.rgb_scale != 1 else ""
    return repair, f"The colour image is {', '.join(words)} compared with the depth image{note}."
