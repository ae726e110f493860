"""Findings on the position of the colour images relative to the depth images, in space and in time."""

import math
from dataclasses import dataclass, replace

from ...config import RepairConfig
from ...types import Camera
from .edges import ColourFit, ColourMotion
from .report import Finding

SHIFT_LIMITS = ((3.0, 1.2), (5.0, 2.0))
"""Shifts from which a recording is doubtful and wrong, in 640ths of the image width, and in compared pixels (the larger
counts). Registered Kinects measure up to 2: their depth edges are ragged."""
SCALE_DOUBTFUL = 0.015
"""Registered recordings measure 0 to 0.005."""
_CLEAR_PEAK = 5.0
"""Smallest peak, in standard deviations, that counts as a shift; real ones have 6 and more."""
OF_OTHER_FRAMES = "of_other_frames"
"""Among the numbers of the registration's finding where colour and depth images of different frames were paired."""
_IN_ORDER = 0.5
"""Share of frames whose most similar colour image is a neighbour in time: 0.99 to 1 in order, 0 shuffled."""
_UNRELATED_PEAK, _UNRELATED_SCORE = 5.0, 0.4
"""Below both, colour has no edges on the depth edges under any shift: wrongly paired frames give up to 4 and 0.2,
registered ones 6 to 10 and 0.9 to 1.4."""


_LAG_SEEN = (1.5, 1.2)
"""A time offset is reported if it moves the edges by this much at the fastest motion, in 640ths of the image width and
in compared pixels (the larger counts: edges cannot be placed better; clean recordings measure up to 1), ..."""
_LAG_SURE, _SHIFT_SURE = 3.0, 3.0
"""... and if it is this many times its standard error; likewise a shift."""
_VAGUE_LAG = 0.25
"""Standard error from which on a time offset cannot be known, frames."""
_FEW_WINDOWS = 6
_TOGETHER = 0.5
"""Correlation of the motion of colour and depth images from which on they belong together."""


@dataclass(frozen=True, kw_only=True)
class ColourEvidence:
    """What was measured of the colour images beside the depth images."""

    fit: ColourFit | None
    motion: ColourMotion | None
    order: float | None
    """Result of ``in_order``."""
    together: float | None
    """Result of ``moving_together``."""
    step_s: float
    """Time between frames, seconds; 0 where it is unknown."""


def registration_findings(evidence: ColourEvidence, camera: Camera) -> tuple[RepairConfig, list[Finding]]:
    """Findings on the position of colour relative to depth, in space and in time; ``camera`` is that of the images."""
    fit, order = evidence.fit, evidence.order
    belongs = evidence.together is not None and evidence.together > _TOGETHER
    mixed = order is not None and order < _IN_ORDER and not belongs
    if fit is None and mixed:
        return RepairConfig(), [_mixed_up({"in_order": order or 0.0})]
    if fit is None:
        text = "Cannot be known from these frames: too few depth edges to compare with colour."
        return RepairConfig(), [Finding(name, "unknown", text) for name in ("registration", "colour time")]
    numbers = {
        "shift_x_px": fit.shift_px[0],
        "shift_y_px": fit.shift_px[1],
        "scale": fit.scale,
        "contrast_on_edges": fit.score,
        "contrast_as_read": fit.score_as_read,
        "peak": fit.peak,
    }
    unrelated = fit.score < _UNRELATED_SCORE and fit.peak < _UNRELATED_PEAK and evidence.motion is None
    if mixed or (unrelated and not belongs):
        return RepairConfig(), [_mixed_up(numbers)]
    if unrelated:
        return RepairConfig(), [_not_registered(numbers)]
    if fit.shift_frames:
        repair, time = _whole_frames(fit)
        return repair, [_placed(fit.peak >= _CLEAR_PEAK, fit.shift_px, numbers), time]
    repair, space = _space_finding(fit, evidence.motion, camera, numbers)
    if repair.rgb_mirror != "none" or repair.rgb_scale != 1:
        text = "Cannot be known before the colour image lies on the depth image: its edges move with their place in it."
        return repair, [space, Finding("colour time", "unknown", text)]
    return repair, [space, _part_of_a_frame(evidence, camera)]


def _mixed_up(numbers: dict[str, float]) -> Finding:
    repair = "pair every depth image with the colour image of its time (names, order, association)"
    text = "The colour images do not belong to the depth images: their order or their edges do not fit."
    return Finding("registration", "wrong", text, numbers | {OF_OTHER_FRAMES: 1.0}, repair)


def _not_registered(numbers: dict[str, float]) -> Finding:
    repair = "register colour to depth with the cameras' calibration, or record with the driver's alignment on"
    text = (
        "Colour is not registered to depth: both show the same motion, so they belong together, but no shift, scale or "
        "mirroring brings their edges together. The images are those of two cameras."
    )
    return Finding("registration", "wrong", text, numbers, repair)


def _placed(clear: bool, shift_px: tuple[float, float], numbers: dict[str, float]) -> Finding:
    """The finding where nothing is wrong, or nothing can be seen."""
    if not clear:
        text = "Cannot be known from these frames: the edges of colour and depth are too few or too similar to compare."
        return Finding("registration", "unknown", text, numbers)
    text = f"Colour edges lie on depth edges within {math.hypot(*shift_px):.1f} pixels."
    return Finding("registration", "ok", text, numbers)


def _space_finding(
    fit: ColourFit, motion: ColourMotion | None, camera: Camera, numbers: dict[str, float]
) -> tuple[RepairConfig, Finding]:
    """Is colour shifted, scaled or mirrored, whatever its time?"""
    doubtful, wrong_from = (max(limit * camera.width / 640, pixels * fit.pixel) for limit, pixels in SHIFT_LIMITS)
    only_shifted = fit.mirror == "none" and abs(fit.scale - 1) <= SCALE_DOUBTFUL
    clear = fit.peak >= _CLEAR_PEAK
    if motion is not None and only_shifted and _lag_is_seen(motion, fit, camera):
        fit, clear = replace(fit, shift_px=motion.shift_px), True  # the time offset smears the peak of all frames
    shift = math.hypot(*fit.shift_px)
    if not clear or (only_shifted and shift < doubtful):
        return RepairConfig(), _placed(clear, fit.shift_px, numbers)
    if only_shifted and _may_be_time(motion, fit, shift, camera):
        text = (
            f"Cannot be known from these frames: colour edges lie {shift:.1f} pixels beside depth edges, but in so few "
            "kinds of motion a shift and a time offset look alike."
        )
        return RepairConfig(), Finding("registration", "unknown", text, numbers)
    repair, text = _registration_repair(fit, shift >= doubtful)
    verdict = "wrong" if not only_shifted or shift >= wrong_from else "doubtful"
    return repair, Finding("registration", verdict, text, numbers, repair.flags)


def _may_be_time(motion: ColourMotion | None, fit: ColourFit, shift_px: float, camera: Camera) -> bool:
    """Whether a time offset of less than a frame could be what looks like a shift."""
    if motion is None or motion.speed_px < shift_px:
        return False
    moved = abs(motion.lag_frames) * motion.speed_px if _lag_is_seen(motion, fit, camera) else 0.0
    return (
        not motion.separable
        or motion.windows < _FEW_WINDOWS
        or shift_px < max(2 * moved, _SHIFT_SURE * motion.shift_error_px)
    )


def _lag_is_seen(motion: ColourMotion, fit: ColourFit, camera: Camera) -> bool:
    far = abs(motion.lag_frames) * motion.speed_px > max(_LAG_SEEN[0] * camera.width / 640, _LAG_SEEN[1] * fit.pixel)
    return motion.separable and far and abs(motion.lag_frames) > _LAG_SURE * motion.lag_error_frames


def _part_of_a_frame(evidence: ColourEvidence, camera: Camera) -> Finding:
    """Were colour and depth taken at the same time, to a part of a frame?"""
    fit, motion, step_s = evidence.fit, evidence.motion, evidence.step_s
    if fit is None or motion is None or not motion.separable or motion.lag_error_frames > _VAGUE_LAG:
        text = (
            "Colour and depth belong to the same frame; a smaller time offset cannot be known: too few kinds of motion."
        )
        return Finding("colour time", "unknown", text, {"shift_frames": 0.0})
    lag, error = abs(motion.lag_frames), motion.lag_error_frames
    numbers = {
        "shift_frames": 0.0,
        "lag_frames": motion.lag_frames,
        "lag_error_frames": error,
        "speed_px": motion.speed_px,
    }
    if not _lag_is_seen(motion, fit, camera):
        text = f"Colour and depth were taken at the same time, within {lag + 2 * error:.2f} frames."
        return Finding("colour time", "ok", text, numbers)
    known = f"{lag:.2f} ± {error:.2f} frames" + (f" ({1000 * lag * step_s:.0f} ms)" if step_s else "")
    text = (
        f"Colour was taken {known} {'later' if motion.lag_frames > 0 else 'earlier'} than depth: over {motion.windows} "
        f"windows its edges move against those of depth with the speed of the image, up to {lag * motion.speed_px:.1f} "
        "pixels."
    )
    repair = (
        "no option moves depth by a part of a frame; gsfusion-nb offset finds the number that gives poses the time of "
        "the colour images; turn the camera more slowly when recording"
    )
    return Finding("colour time", "doubtful", text, numbers, repair)


def _whole_frames(fit: ColourFit) -> tuple[RepairConfig, Finding]:
    """The colour image of another frame fits better."""
    repair = RepairConfig(rgb_shift_frames=fit.shift_frames)
    side = "later" if fit.shift_frames > 0 else "earlier"
    text = f"A frame's depth image belongs to the colour image recorded {abs(fit.shift_frames)} frames {side}."
    return repair, Finding("colour time", "wrong", text, {"shift_frames": float(fit.shift_frames)}, repair.flags)


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
