"""Findings on the position of colour relative to depth, in space and in time."""

import math

from ...config import RepairConfig
from ...data.adjust.first_frames import SmallFrame, colour_difference
from ...types import Camera
from .colour import ColourFit
from .report import Finding
from .sample import Sample

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


PAIR_AGAIN = (
    "pair every depth image with the colour image of its time; register the cameras with their "
    "calibration"
)
_UNRELATED_DIFFERENCE = 0.87
"""Where the same points of two frames differ more in brightness than this share of what pixels in
the same place do, the pictures are not those of the depth images. Wrongly paired frames give 0.92
to 1.05, registered ones 0.15 to 0.31, and up to 0.81 where colour is late or the poses are."""
_FRAMES = 62
"""At most so many frames are compared with each other."""


def unrelated_pictures(sample: Sample, shift_frames: int) -> Finding | None:
    """A finding where the pictures do not move as depth and poses do; None if they do, or if it
    cannot be seen. Edges of depth alone cannot tell: slow motion leaves them nearly in place.

    Args:
        sample: Frames with poses that are right as they are read.
        shift_frames: The picture of a frame is taken from so many frames later.
    """
    by_place = sample.by_place
    facts = [f for f in sample.frames if f.place + shift_frames in by_place][:_FRAMES]
    frames = [
        SmallFrame(
            index=f.number,
            camera=sample.depth_camera,
            depth_m=f.depth_m,
            grey=by_place[f.place + shift_frames].grey,
        )
        for f in facts
    ]
    poses = [f.T_stored for f in facts]
    difference = colour_difference(frames, poses)
    if not difference > _UNRELATED_DIFFERENCE:  # nor where it is NaN
        return None
    text = (
        "The colour images are those of other frames: the same points of two frames differ in "
        f"brightness by {difference:.0%} of what pixels in the same place do (usual: at most 54 %)."
    )
    return Finding("registration", "wrong", text, PAIR_AGAIN)


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
        return none, [Finding("registration", "wrong", text, PAIR_AGAIN)]
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
