"""Findings on the position of colour relative to depth, in space and in time."""

import math

from ...config import RepairConfig
from ...types import Camera
from .colour import ColourFit
from .report import Finding

SHIFT_LIMITS = ((3.0, 1.2), (5.0, 2.0))
"""Shifts from which a recording is doubtful and wrong, in 640ths of the image width, and in
compared pixels (the larger counts). Registered Kinects measure up to 2: their depth edges are
ragged."""

SCALE_DOUBTFUL = 0.015
"""Registered recordings measure 0 to 0.005."""

_CLEAR_PEAK = 5.0
"""Smallest peak, in standard deviations, that counts as a shift; real ones have 6 and more."""

_UNRELATED_SCORE = 0.4
"""With no clear peak either, colour has no edges on the depth edges under any shift: wrongly paired
frames give up to 4 and 0.2, registered ones 6 to 10 and 0.9 to 1.4."""


def registration_findings(
    fit: ColourFit | None, camera: Camera
) -> tuple[RepairConfig, list[Finding]]:
    """Findings on the position of colour relative to depth, in space and in time; ``camera`` is
    that of the images."""
    none = RepairConfig()
    names = ("registration", "colour time")
    if fit is None:
        text = "Cannot be known from these frames: too few depth edges to compare with colour."
        return none, [Finding(name, "unknown", text) for name in names]
    shift = math.hypot(*fit.shift_px)
    clear = fit.peak >= _CLEAR_PEAK
    if not clear and fit.score < _UNRELATED_SCORE:
        text = (
            "The colour images do not lie on the depth images under any shift, scale, mirroring or "
            "time: they are those of other frames, or of a second camera that is not registered."
        )
        repair = (
            "pair every depth image with the colour image of its time; register the cameras "
            "with their calibration"
        )
        return none, [Finding("registration", "wrong", text, repair)]
    time = Finding("colour time", "ok", "Colour and depth belong to the same frame.")
    repair = none
    if fit.shift_frames:
        repair = RepairConfig(rgb_shift_frames=fit.shift_frames)
        side = "later" if fit.shift_frames > 0 else "earlier"
        text = (
            "A frame's depth image belongs to the colour image recorded "
            f"{abs(fit.shift_frames)} frames {side}."
        )
        time = Finding("colour time", "wrong", text, repair.flags)
    if not clear:
        text = (
            "Cannot be known from these frames: the edges of colour and depth are too few or "
            "too similar to compare."
        )
        return repair, [Finding("registration", "unknown", text), time]
    doubtful, wrong = (
        max(limit * camera.width / 640, pixels * fit.pixel) for limit, pixels in SHIFT_LIMITS
    )
    has_change = fit.mirror != "none" or abs(fit.scale - 1) > SCALE_DOUBTFUL
    if not has_change and shift < doubtful:
        text = f"Colour edges lie on depth edges within {shift:.1f} pixels."
        return repair, [Finding("registration", "ok", text), time]
    if not has_change and fit.may_be_time:
        text = (
            f"Cannot be known from these frames: colour edges lie {shift:.1f} pixels beside depth "
            "edges, but in so few kinds of motion a shift and a time offset look alike."
        )
        return repair, [Finding("registration", "unknown", text), time]
    repair, text = _registration_repair(fit, shift >= doubtful)
    verdict = "wrong" if has_change or shift >= wrong else "doubtful"
    return repair, [Finding("registration", verdict, text, repair.flags), time]


def _registration_repair(fit: ColourFit, has_shift: bool) -> tuple[RepairConfig, str]:
    has_scale = abs(fit.scale - 1) > SCALE_DOUBTFUL
    x, y = fit.shift_px if has_shift or has_scale else (0.0, 0.0)
    repair = RepairConfig(
        rgb_mirror=fit.mirror,  # pyright: ignore[reportArgumentType]
        rgb_shift_x_px=round(x, 1),
        rgb_shift_y_px=round(y, 1),
        rgb_scale=fit.scale if has_scale else 1.0,
    )
    mirrors = {
        "none": "",
        "x": "mirrored left to right",
        "y": "upside down",
        "xy": "rotated by 180 degrees",
    }
    sides = (
        f"{abs(x):.1f} pixels to the {'right' if x > 0 else 'left'} and {abs(y):.1f} "
        f"{'down' if y > 0 else 'up'}"
    )
    words = [
        mirrors[fit.mirror],
        f"{fit.scale:.2f} times as large" * has_scale,
        f"shifted by {sides}" * bool(x or y),
    ]
    return (
        repair,
        f"The colour image is {', '.join(filter(None, words))} compared with the depth image.",
    )
