"""Findings on scale and poses, from the best explanation."""

import math
from dataclasses import replace

from ...config import RepairConfig
from ...config.parts import NAMED_AXES
from ...types import Camera
from .corrections import CLEAR
from .explain import Explanation, repair_fields
from .findings import Finding, Verdict

_HARDLY = 1 / 3
_VAGUE_SCALE, _VAGUE_FRAMES = 0.2, 1.0
"""Uncertainties from which on a scale and a time offset cannot be known."""
_SAME = 0.01
"""Another interpretation that scores at most this much lower explains the frames as well."""
_TYPICAL_ERROR = 0.02


def agreement_finding(e: Explanation, usual_error: float) -> Finding:
    """Finding: do frames agree after all repairs?"""
    numbers = {
        "agreeing_as_read": e.before.agreeing,
        "agreeing_repaired": e.after.agreeing,
        "error_as_read_m": e.before.median_m,
        "error_repaired_m": e.after.median_m,
        "relative_error": usual_error,
    }
    text = (
        f"{e.after.agreeing:.0%} of a frame's points agree with another frame within 3 %, the median difference is "
        f"{_cm(e.after.median_m)}"
    )
    if e.after.flags:
        text += f" with the repair (as read: {e.before.agreeing:.0%}, {_cm(e.before.median_m)})"
    if usual_error > _TYPICAL_ERROR or not math.isfinite(usual_error):
        return Finding(
            name="agreement",
            verdict="wrong",
            numbers=numbers,
            sentence=f"{text}: no interpretation or correction explains the data.",
            repair="check that poses and images belong together; compare the pictures on the page",
        )
    if e.after.agreeing < _HARDLY and usual_error > _TYPICAL_ERROR / 2:
        return Finding(
            name="agreement",
            verdict="doubtful",
            numbers=numbers,
            sentence=f"{text}: little overlap, or imprecise poses.",
            repair="",
        )
    return Finding(name="agreement", verdict="ok", numbers=numbers, sentence=f"{text}.")


def scale_finding(e: Explanation, camera: Camera) -> Finding:
    """Finding on the units of depth and positions."""
    fields = repair_fields(e.corrected.correction, camera, e.interpretation)
    factor, translation = fields.get("depth_factor", e.interpretation.depth_factor), e.interpretation.translation_factor
    repair = RepairConfig(depth_factor=factor, translation_factor=translation)
    fitted = e.corrected.last_fit("depth scale")
    known = (
        f"± {100 * fitted.uncertainty:.1f} %" if fitted and math.isfinite(fitted.uncertainty) else "not known precisely"
    )
    if repair == RepairConfig():
        vague = "depth scale" in e.unconfirmed or (fitted is not None and fitted.uncertainty > _VAGUE_SCALE)
        if vague:
            text = (
                "Whether depth and positions have the same unit cannot be known from these frames: the camera hardly "
                f"moves, or parts of the recording disagree ({known})."
            )
            return Finding(name="depth scale", verdict="unknown", numbers={"factor": 1.0}, sentence=text)
        return Finding(
            name="depth scale",
            verdict="ok",
            numbers={"factor": 1.0},
            sentence=f"Depth and positions have the same unit ({known} from these frames).",
        )
    adopted = e.corrected.adopted_fit("depth scale")
    verdict: Verdict = "wrong" if adopted is None or adopted.ratio < CLEAR else "doubtful"
    if translation != 1.0:
        text = f"The positions of the poses must be multiplied by {translation:g} to be metres."
    else:
        text = f"Depth must be multiplied by {factor:g}{_scale_words(factor)}."
    return Finding(
        name="depth scale",
        verdict=verdict,
        numbers={"factor": factor, "translation_factor": translation},
        sentence=text,
        repair=repair.flags,
    )


def kind_finding(e: Explanation) -> Finding:
    """Finding: is depth z-depth, or the length of the ray?"""
    if e.corrected.correction.ray:
        return Finding(
            name="depth kind",
            verdict="wrong",
            repair=RepairConfig(depth_kind="ray").flags,
            numbers={"cost_ratio": e.corrected.cost_ratio("depth kind")},
            sentence="Depth is the distance along each pixel's ray, not along the optical axis.",
        )
    ratio = e.corrected.cost_ratio("depth kind")
    same = abs(ratio - 1) < _SAME
    return Finding(
        name="depth kind",
        verdict="unknown" if same else "ok",
        numbers={"cost_ratio_if_ray": ratio},
        sentence="Whether depth is measured along the optical axis cannot be known from these frames."
        if same
        else "Depth is measured along the optical axis.",
    )


def convention_findings(e: Explanation) -> list[Finding]:
    """Findings on direction, axes and quaternion order of the poses."""
    r = e.interpretation
    words = {
        "world_to_camera": "The poses are world-to-camera: they must be inverted.",
        "rotation_inverted": "The rotations are world-to-camera, but the positions are those of the camera.",
        "camera_to_world": "The poses are camera-to-world.",
    }
    numbers = {"agreeing_as_read": e.before.agreeing, "agreeing_repaired": e.after.agreeing}
    named = f"{r.axes} ({NAMED_AXES[r.axes]})" if r.axes in NAMED_AXES else r.axes
    mirrored = " and mirror the world" if _mirrors(r) else ""
    order = "The quaternions are stored {} but were read in the other order."
    score = next((t.score for t in e.tried if _is_same(t.poses, r)), 0.0)
    findings = [
        _convention(
            "pose direction", r.poses != "camera_to_world", words[r.poses], RepairConfig(poses=r.poses), numbers
        ),
        _convention(
            "pose axes",
            r.axes != "opencv",
            f"The camera axes of the poses are those of {named}{mirrored}.",
            RepairConfig(axes=r.axes),
            numbers,
        ),
        _convention(
            "quaternion order",
            r.quaternions != "as_read",
            order.format(r.quaternions) if r.quaternions != "as_read" else "The rotations are read in the right order.",
            RepairConfig(quaternions=r.quaternions),
            numbers,
        ),
    ]
    return [
        _open(f) if f.verdict == "ok" and _another_fits(e, r, name, score) else f
        for f, name in zip(findings, ("poses", "axes", "quaternions"), strict=True)
    ]


def _is_same(a: RepairConfig, b: RepairConfig) -> bool:
    return (a.poses, a.axes, a.quaternions) == (b.poses, b.axes, b.quaternions)


def _another_fits(e: Explanation, r: RepairConfig, name: str, score: float) -> bool:
    """Whether an interpretation that differs in this field explains the frames as well."""
    return any(getattr(t.poses, name) != getattr(r, name) and t.score > score - _SAME for t in e.tried)


def _open(f: Finding) -> Finding:
    """The finding, as one that these frames cannot decide."""
    text = "Cannot be known from these frames: they agree as well under another convention; more motion would tell."
    return replace(f, verdict="unknown", sentence=text)


def time_finding(e: Explanation, camera: Camera) -> Finding:
    """Finding: are the poses earlier or later than the depth images?"""
    shift = e.corrected.correction.shift_frames
    fitted = e.corrected.last_fit("pose time")
    known = fitted.uncertainty if fitted else math.nan
    if "pose time" in e.unconfirmed or (not shift and known > _VAGUE_FRAMES):
        given = ", ".join(f"{v:.1f}" for v in e.unconfirmed.get("pose time", ()))
        text = f"parts of the recording give {given} frames" if given else f"± {known:.1f} frames"
        return Finding(
            name="pose time",
            verdict="unknown",
            numbers={"shift_frames": 0.0},
            sentence=f"Whether poses and depth have the same time cannot be known from these frames ({text}).",
        )
    if not shift:
        sure = f" (± {known:.2f} frames)" if math.isfinite(known) else ""
        return Finding(
            name="pose time",
            verdict="ok",
            numbers={"shift_frames": 0.0},
            sentence=f"Poses and depth have the same time{sure}.",
        )
    fields = repair_fields(e.corrected.correction, camera, e.interpretation)
    ratio = e.corrected.cost_ratio("pose time")
    return Finding(
        name="pose time",
        verdict="wrong" if ratio < CLEAR else "doubtful",
        numbers={"shift_frames": shift, "cost_ratio": ratio},
        repair=RepairConfig(pose_shift_frames=fields["pose_shift_frames"]).flags,
        sentence=(
            f"A frame's depth image belongs to the pose recorded {abs(shift):.1f} frames "
            f"{'later' if shift > 0 else 'earlier'}."
        ),
    )


def _convention(name: str, changed: bool, text: str, repair: RepairConfig, numbers: dict[str, float]) -> Finding:
    if not changed:
        return Finding(name=name, verdict="ok", sentence=text)
    return Finding(name=name, verdict="wrong", sentence=text, repair=repair.flags, numbers=numbers)


def _mirrors(r: RepairConfig) -> bool:
    kinds = {"right": 0, "left": 0, "down": 1, "up": 1, "forward": 2, "back": 2}
    order = [kinds[w] for w in r.axis_words]
    swaps = sum(a > b for i, a in enumerate(order) for b in order[i + 1 :])
    return (swaps + sum(w in ("left", "up", "back") for w in r.axis_words)) % 2 == 1


def _scale_words(factor: float) -> str:
    known = {
        0.2: "a metre is 5000 units, not 1000",
        5.0: "a metre is 1000 units, not 5000",
        0.001: "it is in millimetres",
        1000.0: "it was divided by 1000 twice",
        10.0: "the scale is ten times too large",
        0.1: "the scale is ten times too small",
        0.01: "it is in centimetres",
    }
    return f" ({known[factor]})" if factor in known else ""


def _cm(metres: float) -> str:
    return f"{100 * metres:.2g} cm" if math.isfinite(metres) else "unknown"
