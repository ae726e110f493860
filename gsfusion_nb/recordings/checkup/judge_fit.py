"""Findings on scale, poses and intrinsics, from the best explanation."""

import math
from collections.abc import Sequence
from dataclasses import replace

from ...config import RepairConfig
from ...config.parts import NAMED_AXES
from ...types import Camera
from .explain import Explanation
from .fit import CLEAR
from .report import Finding, Verdict

_HARDLY = 1 / 3
_VAGUE_SCALE, _VAGUE_FRAMES, _VAGUE_FOCAL, _VAGUE_CENTRE = 0.2, 1.0, 0.1, 8.0
"""Uncertainties from which on a scale (share), a time offset (frames), the focal lengths (share) and the principal
point (640ths of the image width) cannot be known."""
_SAME = 0.01
"""Another interpretation that scores at most this much lower explains the frames as well."""
_TYPICAL_ERROR = 0.02
_CONVENTIONS = {"poses": "pose direction", "axes": "pose axes", "quaternions": "quaternion order"}
_IMITATED = "; what the motion does to the images (a time offset, a rolling shutter) can look the same"


def agreement_finding(e: Explanation, flags: str, usual_error: float) -> Finding:
    """Finding: do frames agree after all repairs (``flags``)?"""
    numbers = {
        "agreeing_as_read": e.as_read.share,
        "agreeing_repaired": e.repaired.share,
        "error_as_read_m": e.as_read.median_m,
        "error_repaired_m": e.repaired.median_m,
        "relative_error": usual_error,
    }
    text = (
        f"{e.repaired.share:.0%} of a frame's points agree with another frame within 3 %, the median difference is "
        f"{_cm(e.repaired.median_m)}"
    )
    if flags:
        text += f" with the repair (as read: {e.as_read.share:.0%}, {_cm(e.as_read.median_m)})"
    if usual_error > _TYPICAL_ERROR or not math.isfinite(usual_error):
        repair = "check that poses and images belong together; compare the pictures on the page"
        text += ": no interpretation or correction explains the data."
        return Finding("agreement", "wrong", text, numbers, repair)
    if e.repaired.share < _HARDLY and usual_error > _TYPICAL_ERROR / 2:
        return Finding("agreement", "doubtful", f"{text}: little overlap, or imprecise poses.", numbers)
    return Finding("agreement", "ok", f"{text}.", numbers)


def fit_findings(e: Explanation, camera: Camera) -> list[Finding]:
    """Findings on units, kind of depth, conventions and time of the poses, and intrinsics."""
    fields = e.fields(camera)
    resized = e.corrected.adopted_fit("intrinsics size") is not None
    focal, centre = ({k: v for k, v in fields.items() if k in names} for names in (("fx", "fy"), ("cx", "cy")))
    return [
        _scale(e, fields),
        _depth_kind(e),
        *_conventions(e),
        _pose_time(e, fields),
        _focal(e, camera, focal, centre if resized else {}),
        _centre(e, camera, {} if resized else centre),
        _pixel_centre(e, fields.get("pixel_shift", 0.0)),
    ]


def _uncertainty(e: Explanation, kind: str) -> float:
    """Of the last fit of a kind of correction; NaN if it is unknown."""
    fitted = e.corrected.last_fit(kind)
    return fitted.uncertainty if fitted else math.nan


def _by_cost(ratio: float) -> Verdict:
    return "wrong" if ratio < CLEAR else "doubtful"


def _scale(e: Explanation, fields: dict) -> Finding:
    """The units of depth and positions."""
    factor, translation = fields.get("depth_factor", e.interpretation.depth_factor), e.interpretation.translation_factor
    repair = RepairConfig(depth_factor=factor, translation_factor=translation)
    if repair == RepairConfig():
        error = _uncertainty(e, "depth scale")
        known = f"± {100 * error:.1f} %" if math.isfinite(error) else "not known precisely"
        if "depth scale" in e.unconfirmed or error > _VAGUE_SCALE:
            text = (
                "Whether depth and positions have the same unit cannot be known from these frames: the camera hardly "
                f"moves, or parts of the recording disagree ({known})."
            )
            return Finding("depth scale", "unknown", text, {"factor": 1.0})
        text = f"Depth and positions have the same unit ({known} from these frames)."
        return Finding("depth scale", "ok", text, {"factor": 1.0})
    adopted = e.corrected.adopted_fit("depth scale")
    text = f"Depth must be multiplied by {factor:g}{_scale_words(factor)}."
    if translation != 1.0:
        text = f"The positions of the poses must be multiplied by {translation:g} to be metres."
    numbers = {"factor": factor, "translation_factor": translation}
    return Finding("depth scale", _by_cost(adopted.ratio) if adopted else "wrong", text, numbers, repair.flags)


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


def _depth_kind(e: Explanation) -> Finding:
    """Is depth z-depth, or the length of the ray?"""
    ratio = e.corrected.cost_ratio("depth kind")
    if e.corrected.correction.ray:
        text = "Depth is the distance along each pixel's ray, not along the optical axis."
        return Finding("depth kind", "wrong", text, {"cost_ratio": ratio}, RepairConfig(depth_kind="ray").flags)
    if abs(ratio - 1) < _SAME:
        text = "Whether depth is measured along the optical axis cannot be known from these frames."
        return Finding("depth kind", "unknown", text, {"cost_ratio_if_ray": ratio})
    return Finding("depth kind", "ok", "Depth is measured along the optical axis.", {"cost_ratio_if_ray": ratio})


def _conventions(e: Explanation) -> list[Finding]:
    """Direction, axes and quaternion order of the poses."""
    r = e.interpretation
    direction = {
        "world_to_camera": "The poses are world-to-camera: they must be inverted.",
        "rotation_inverted": "The rotations are world-to-camera, but the positions are those of the camera.",
        "camera_to_world": "The poses are camera-to-world.",
    }
    named = f"{r.axes} ({NAMED_AXES[r.axes]})" if r.axes in NAMED_AXES else r.axes
    axes = f"The camera axes of the poses are those of {named}{' and mirror the world' if _mirrors(r) else ''}."
    order = f"The quaternions are stored {r.quaternions} but were read in the other order."
    if r.quaternions == "as_read":
        order = "The rotations are read in the right order."
    same = (t.score for t in e.tried if all(getattr(t.poses, k) == getattr(r, k) for k in _CONVENTIONS))
    score = next(same, 0.0)
    numbers = {"agreeing_as_read": e.as_read.share, "agreeing_repaired": e.repaired.share}
    findings = []
    for (field, name), text in zip(_CONVENTIONS.items(), (direction[r.poses], axes, order), strict=True):
        if field in r.changes:
            repair = replace(RepairConfig(), **{field: getattr(r, field)})
            findings.append(Finding(name, "wrong", text, numbers, repair.flags))
        elif any(getattr(t.poses, field) != getattr(r, field) and t.score > score - _SAME for t in e.tried):
            text = "they agree as well under another convention; more motion would tell."
            findings.append(Finding(name, "unknown", f"Cannot be known from these frames: {text}"))
        else:
            findings.append(Finding(name, "ok", text))
    return findings


def _mirrors(r: RepairConfig) -> bool:
    kinds = {"right": 0, "left": 0, "down": 1, "up": 1, "forward": 2, "back": 2}
    order = [kinds[w] for w in r.axis_words]
    swaps = sum(a > b for i, a in enumerate(order) for b in order[i + 1 :])
    return (swaps + sum(w in ("left", "up", "back") for w in r.axis_words)) % 2 == 1


def _pose_time(e: Explanation, fields: dict) -> Finding:
    """Are the poses earlier or later than the depth images?"""
    shift, known = e.corrected.correction.shift_frames, _uncertainty(e, "pose time")
    if "pose time" in e.unconfirmed or (not shift and known > _VAGUE_FRAMES):
        given = ", ".join(f"{v:.1f}" for v in e.unconfirmed.get("pose time", ()))
        why = f"parts of the recording give {given} frames" if given else f"± {known:.1f} frames"
        text = f"Whether poses and depth have the same time cannot be known from these frames ({why})."
        return Finding("pose time", "unknown", text, {"shift_frames": 0.0})
    if not shift:
        sure = f" (± {known:.2f} frames)" if math.isfinite(known) else ""
        return Finding("pose time", "ok", f"Poses and depth have the same time{sure}.", {"shift_frames": 0.0})
    ratio = e.corrected.cost_ratio("pose time")
    side = "later" if shift > 0 else "earlier"
    text = f"A frame's depth image belongs to the pose recorded {abs(shift):.1f} frames {side}."
    repair = RepairConfig(pose_shift_frames=fields["pose_shift_frames"])
    return Finding("pose time", _by_cost(ratio), text, {"shift_frames": shift, "cost_ratio": ratio}, repair.flags)


def _fits(
    name: str, what: str, numbers: dict[str, float], doubts: Sequence[str], unit: str, vague: bool, given: str
) -> Finding:
    """The finding on intrinsics that need no correction; ``doubts`` is what single parts of the recording ask for."""
    if doubts or vague:
        asked = f"parts of the recording ask for {', '.join(doubts)}{unit}{_IMITATED}"
        why = asked if doubts else "too little motion"
        return Finding(name, "unknown", f"Whether {what} cannot be known from these frames: {why}.", numbers)
    return Finding(name, "ok", f"{what.capitalize()} ({given}).", numbers)


def _focal(e: Explanation, camera: Camera, focal: dict, centre: dict) -> Finding:
    """The focal lengths; with a ``centre`` all intrinsics are those of another image size."""
    numbers = {"fx": camera.fx, "fy": camera.fy, **{f"{k}_measured": v for k, v in focal.items()}}
    old = f"fx {camera.fx:.1f}, fy {camera.fy:.1f}"
    if not focal:
        error = _uncertainty(e, "focal length")
        doubts = e.unconfirmed.get("focal length", e.unconfirmed.get("fx / fy", ()))
        parts = [f"{100 * math.expm1(v):+.1f} %" for v in doubts]
        known = f"{old}, ± {100 * error:.1f} %" if math.isfinite(error) else old
        return _fits("focal length", "the focal lengths fit", numbers, parts, "", error > _VAGUE_FOCAL, known)
    ratio = min(e.corrected.cost_ratio(k) for k in ("focal length", "fx / fy", "intrinsics size"))
    text = f"The focal lengths are wrong: {old}, but the depth images give fx {focal['fx']:.1f}, fy {focal['fy']:.1f}"
    if focal == {"fx": camera.fy, "fy": camera.fx}:
        text += ": they are exchanged"
    if centre:
        times = f"{camera.fx / focal['fx']:.3g} times as large"
        text += f", and the principal point has the same factor: the intrinsics are those of images {times}"
    repair = replace(RepairConfig(), **focal, **centre)
    return Finding("focal length", _by_cost(ratio), f"{text}.", numbers | {"cost_ratio": ratio}, repair.flags)


def _centre(e: Explanation, camera: Camera, centre: dict) -> Finding:
    numbers = {"cx": camera.cx, "cy": camera.cy, **{f"{k}_measured": v for k, v in centre.items()}}
    if not centre:
        error = _uncertainty(e, "principal point")
        parts = [f"{v:+.0f}" for v in e.unconfirmed.get("principal point", ())]
        known = f"cx {camera.cx:.1f}, cy {camera.cy:.1f}"
        known += f", ± {error:.1f} pixels" if math.isfinite(error) else ""
        vague = error > _VAGUE_CENTRE * camera.width / 640
        return _fits("principal point", "the principal point fits", numbers, parts, " pixels", vague, known)
    ratio = e.corrected.cost_ratio("principal point")
    old, new = f"{camera.cx:.1f}, {camera.cy:.1f}", f"{centre['cx']:.1f}, {centre['cy']:.1f}"
    text = f"The principal point is wrong: {old}, but the depth images give {new}"
    if centre == {"cx": camera.cy, "cy": camera.cx}:
        text += ": cx and cy are exchanged"
    repair = replace(RepairConfig(), **centre)
    return Finding("principal point", _by_cost(ratio), f"{text}.", numbers | {"cost_ratio": ratio}, repair.flags)


def _pixel_centre(e: Explanation, shift: float) -> Finding:
    known = _uncertainty(e, "principal point")
    if shift:
        text = (
            f"cx and cy are half a pixel too {'small' if shift > 0 else 'large'}: the first pixel's centre is "
            f"{'0' if shift > 0 else '0.5'} in the intrinsics, but not for the reader."
        )
        numbers = {"shift_px": shift, "cost_ratio": e.corrected.cost_ratio("principal point")}
        return Finding("pixel centres", "doubtful", text, numbers, RepairConfig(pixel_shift=shift).flags)
    if not known < 0.4:
        text = "Half a pixel makes no measurable difference in these frames."
        return Finding("pixel centres", "unknown", text, {"known_to_px": known})
    return Finding("pixel centres", "ok", "cx and cy are right within half a pixel.", {"known_to_px": known})


def _cm(metres: float) -> str:
    return f"{100 * metres:.2g} cm" if math.isfinite(metres) else "unknown"
