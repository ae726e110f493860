"""Findings on scale and poses, from the best explanation."""

from dataclasses import replace

from ...config import RepairConfig
from ...config.repair import NAMED_AXES
from ...types import Camera
from .agreement import median_error
from .explain import Explanation
from .judge_intrinsics import correction_finding, intrinsics_findings
from .report import Finding

_HARDLY = 1 / 3
_SAME = 0.01
"""Another interpretation that scores at most this much lower explains the frames as well."""
_TYPICAL_ERROR = 0.02
_VAGUE_SCALE = 0.2
"""A scale that is less certain than this cannot be known, as a share."""
_VAGUE_FRAMES = 1.0
"""Likewise a time offset, frames."""
_SCALES = {
    0.2: " (a metre is 5000 units, not 1000)",
    5.0: " (a metre is 1000 units, not 5000)",
    0.001: " (it is in millimetres)",
    1000.0: " (it was divided by 1000 twice)",
}


def agreement_finding(e: Explanation) -> Finding:
    """Finding: do frames agree after all repairs?"""
    usual_error = median_error(e.data, e.correction)
    text = (
        f"{e.repaired.share:.0%} of a frame's points agree with another frame within 3 %, the "
        f"median difference is {100 * e.repaired.median_m:.2g} cm"
    )
    if e.repair.changes:
        text += (
            f" with the repair (as read: {e.as_read.share:.0%}, {100 * e.as_read.median_m:.2g} cm)"
        )
    if not usual_error <= _TYPICAL_ERROR:
        repair = "check that poses and images belong together; compare the pictures on the page"
        return Finding(
            "agreement", "wrong", f"{text}: no interpretation explains the data.", repair
        )
    if e.repaired.share < _HARDLY and usual_error > _TYPICAL_ERROR / 2:
        return Finding("agreement", "doubtful", f"{text}: little overlap, or imprecise poses.")
    return Finding("agreement", "ok", f"{text}.")


def fit_findings(e: Explanation, camera: Camera, lens: Camera | None = None) -> list[Finding]:
    """Findings on units, kind of depth, conventions and time of the poses, and intrinsics.

    Args:
        e: The explanation.
        camera: Of the frames.
        lens: Camera of the stored images, where their distortion was removed.
    """
    return [
        _scale_finding(e),
        _depth_kind_finding(e),
        *_conventions(e),
        _pose_time_finding(e),
        *intrinsics_findings(e, camera, lens),
    ]


def _scale_finding(e: Explanation) -> Finding:
    """The units of depth and of positions."""
    repair = e.repair
    uncertainty = e.fits["depth scale"].uncertainty
    words = _SCALES.get(repair.depth_factor, "")
    wrong = f"Depth must be multiplied by {repair.depth_factor:g}{words}."
    if repair.translation_factor != 1.0:
        wrong = (
            f"The positions of the poses must be multiplied by {repair.translation_factor:g} to be "
            "metres."
        )
    return correction_finding(
        e,
        "depth scale",
        fields=("depth_factor", "translation_factor"),
        kinds=("depth scale",),
        wrong=wrong,
        right=f"Depth and positions have the same unit (± {100 * uncertainty:.1f} %).",
        is_vague=not uncertainty <= _VAGUE_SCALE,
    )


def _depth_kind_finding(e: Explanation) -> Finding:
    """Whether depth is z-depth, or the length of the ray."""
    return correction_finding(
        e,
        "depth kind",
        fields=("depth_kind",),
        kinds=("depth kind",),
        wrong="Depth is the distance along each pixel's ray, not along the optical axis.",
        right="Depth is measured along the optical axis.",
        is_vague=abs(e.fits["depth kind"].ratio - 1) < _SAME,
    )


def _pose_time_finding(e: Explanation) -> Finding:
    """Whether the poses are earlier or later than the images."""
    repair = e.repair
    shift = repair.pose_shift_frames
    uncertainty = e.fits["pose time"].uncertainty
    if shift:
        side = "later" if shift > 0 else "earlier"
        wrong = (
            f"A frame's depth image belongs to the pose recorded {abs(shift):.1f} frames {side}."
        )
    else:
        rgb_ms = 1000 * repair.pose_offset_s + 0.0
        depth_ms = 1000 * (repair.pose_offset_s + repair.depth_offset_s)
        wrong = (
            f"Pictures were taken {rgb_ms:+.0f} ms and depth images {depth_ms:+.0f} ms after "
            "their time stamps."
        )
    return correction_finding(
        e,
        "pose time",
        fields=("pose_shift_frames", "pose_offset_s", "depth_offset_s"),
        kinds=("pose time",),
        wrong=wrong,
        right=f"Poses and depth have the same time (± {uncertainty:.2f} frames).",
        is_vague=not uncertainty <= _VAGUE_FRAMES,
    )


def _conventions(e: Explanation) -> list[Finding]:
    """Direction, axes and quaternion order of the poses."""
    r = e.interpretation
    direction = {
        "world_to_camera": "The poses are world-to-camera: they must be inverted.",
        "rotation_inverted": "The rotations are world-to-camera, but the positions are those of "
        "the camera.",
        "camera_to_world": "The poses are camera-to-world.",
    }
    axes_name = NAMED_AXES.get(r.axes, r.axes)
    texts = {
        "poses": ("pose direction", direction[r.poses]),
        "axes": ("pose axes", f"The camera axes of the poses are those of {r.axes} ({axes_name})."),
        "quaternions": ("quaternion order", "The rotations are read in the right order."),
    }
    if r.quaternions != "as_read":
        texts["quaternions"] = (
            "quaternion order",
            f"The quaternions are stored {r.quaternions}, not as read.",
        )
    mine = [t for t in e.tried if all(getattr(t.repair, k) == getattr(r, k) for k in texts)]
    score = mine[0].score if mine else 0.0
    findings = []
    for field, (name, text) in texts.items():
        if field in r.changes:
            repair = replace(RepairConfig(), **{field: getattr(r, field)})
            findings.append(Finding(name, "wrong", text, repair=repair.flags))
        elif any(
            getattr(t.repair, field) != getattr(r, field) and t.score > score - _SAME
            for t in e.tried
        ):
            text = "they agree as well under another convention; more motion would tell."
            findings.append(Finding(name, "unknown", f"Cannot be known from these frames: {text}"))
        else:
            findings.append(Finding(name, "ok", text))
    return findings
