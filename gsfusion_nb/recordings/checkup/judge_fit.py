"""Findings on scale, poses and intrinsics, from the best explanation."""

from dataclasses import replace

from ...config import RepairConfig
from ...config.repair import NAMED_AXES
from ...types import Camera
from .explain import Explanation
from .fit import CLEAR, median_error
from .report import Finding

_HARDLY = 1 / 3
_SAME = 0.01
"""Another interpretation that scores at most this much lower explains the frames as well."""
_TYPICAL_ERROR = 0.02
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


def fit_findings(
    e: Explanation,
    camera: Camera,
    lens: Camera | None = None,
) -> list[Finding]:
    """Findings on units, kind of depth, conventions and time of the poses, and intrinsics.

    Args:
        e: The explanation.
        camera: Of the frames.
        lens: Camera of the stored images, where their distortion was removed.
    """
    r = e.repair
    shift = e.repair.pose_shift_frames
    scale = f"Depth must be multiplied by {r.depth_factor:g}{_SCALES.get(r.depth_factor, '')}."
    if r.translation_factor != 1.0:
        scale = (
            f"The positions of the poses must be multiplied by {r.translation_factor:g} to be "
            "metres."
        )
    side = "later" if shift > 0 else "earlier"
    late = f"A frame's depth image belongs to the pose recorded {abs(shift):.1f} frames {side}."
    if not shift:
        rgb_ms = 1000 * r.pose_offset_s + 0.0
        depth_ms = 1000 * (r.pose_offset_s + r.depth_offset_s)
        late = (
            f"Pictures were taken {rgb_ms:+.0f} ms and depth images {depth_ms:+.0f} ms after "
            "their time stamps."
        )
    focal = (
        f"The focal lengths are wrong: fx {camera.fx:.1f}, fy {camera.fy:.1f}, but the depth "
        "images give fx "
    )
    focal += f"{r.fx:.1f}, fy {r.fy:.1f}"
    if "intrinsics size" in e.adopted:
        focal += f": the intrinsics are those of images {camera.fx / r.fx:.3g} times as large"
    centre = (
        f"The principal point is wrong: {camera.cx:.1f}, {camera.cy:.1f}, but the depth "
        f"images give {r.cx:.1f}, "
    )
    ray = "Depth is the distance along each pixel's ray, not along the optical axis."
    undistorted = (
        f" without distortion; the lens has {lens.fx:.1f} and {lens.fy:.1f}" if lens else ""
    )
    known = {kind: fit.uncertainty for kind, fit in e.fits.items()}
    same = {
        "depth scale": "Depth and positions have the same unit (± "
        f"{100 * known['depth scale']:.1f} %).",
        "pose time": f"Poses and depth have the same time (± {known['pose time']:.2f} frames).",
        "focal length": f"The focal lengths fit (fx {camera.fx:.1f}, fy "
        f"{camera.fy:.1f}{undistorted}, ± {100 * known['focal length']:.1f} %).",
        "principal point": f"The principal point fits (cx {camera.cx:.1f}, cy {camera.cy:.1f}, ± "
        f"{known['principal point']:.1f} pixels).",
    }
    vague = {
        "depth scale": 0.2,
        "pose time": 1.0,
        "focal length": 0.1,
        "principal point": 8.0 * camera.width / 640,
    }
    unclear = {kind for kind, limit in vague.items() if not known[kind] <= limit}
    if abs(e.fits["depth kind"].ratio - 1) < _SAME:
        unclear.add("depth kind")

    def judged(
        name: str,
        fields: tuple[str, ...],
        wrong: str,
        right: str,
        *kinds: str,
    ) -> Finding:
        """One property that the ``fields`` of the repair correct; ``kinds`` of corrections change
        them."""
        mine = {f: v for f, v in r.changes.items() if f in fields}
        ratio = min((e.adopted[kind].ratio for kind in kinds if kind in e.adopted), default=0.0)
        if mine:
            repair = replace(RepairConfig(), **mine)  # pyright: ignore[reportArgumentType]
            return Finding(name, "wrong" if ratio < CLEAR else "doubtful", wrong, repair.flags)
        contradicted = not e.contradicted.isdisjoint(kinds)
        if contradicted or name in unclear:
            why = (
                "parts of the recording contradict each other"
                if contradicted
                else "there is too little motion"
            )
            return Finding(name, "unknown", f"Cannot be known from these frames: {why}.")
        return Finding(name, "ok", right)

    axis = "Depth is measured along the optical axis."
    lengths = ("focal length", "fx / fy", "intrinsics size")
    units = ("depth_factor", "translation_factor")
    return [
        judged("depth scale", units, scale, same["depth scale"], "depth scale"),
        judged("depth kind", ("depth_kind",), ray, axis, "depth kind"),
        *_conventions(e),
        judged(
            "pose time",
            ("pose_shift_frames", "pose_offset_s", "depth_offset_s"),
            late,
            same["pose time"],
            "pose time",
        ),
        judged("focal length", ("fx", "fy"), f"{focal}.", same["focal length"], *lengths),
        judged(
            "principal point",
            ("cx", "cy"),
            f"{centre}{r.cy:.1f}.",
            same["principal point"],
            "principal point",
        ),
    ]


def _conventions(e: Explanation) -> list[Finding]:
    """Direction, axes and quaternion order of the poses."""
    r = e.interpretation
    direction = {
        "world_to_camera": "The poses are world-to-camera: they must be inverted.",
        "rotation_inverted": "The rotations are world-to-camera, but the positions are those of "
        "the camera.",
        "camera_to_world": "The poses are camera-to-world.",
    }
    named = NAMED_AXES.get(r.axes, r.axes)
    texts = {
        "poses": ("pose direction", direction[r.poses]),
        "axes": ("pose axes", f"The camera axes of the poses are those of {r.axes} ({named})."),
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
