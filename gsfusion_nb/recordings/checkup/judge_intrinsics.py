"""Findings on the focal lengths, the principal point and the pixel centres, from the best
explanation, and the rule that all findings on a correction follow.
"""

from dataclasses import replace

from ...config import RepairConfig
from ...types import Camera
from .explain import Explanation
from .fit import CLEAR
from .report import Finding

_VAGUE_FOCAL = 0.1
"""Focal lengths that are less certain than this cannot be known, as a share."""
_VAGUE_CENTRE = 8.0 / 640
"""Likewise a principal point, as a share of the width."""
_HALF_PIXEL = 0.4
"""A principal point that is less certain than this says nothing about half a pixel, pixels."""


def correction_finding(
    e: Explanation,
    name: str,
    *,
    fields: tuple[str, ...],
    kinds: tuple[str, ...],
    wrong: str,
    right: str,
    is_vague: bool,
) -> Finding:
    """The finding on one property of a recording.

    Args:
        e: The explanation.
        name: Of the finding.
        fields: Of the repair that correct the property.
        kinds: Of corrections that change these fields.
        wrong: What to say if the repair sets one of the fields.
        right: What to say if it sets none.
        is_vague: The property cannot be known from the frames.
    """
    changes = {field: value for field, value in e.repair.changes.items() if field in fields}
    if changes:
        ratio = min((e.adopted[kind].ratio for kind in kinds if kind in e.adopted), default=0.0)
        repair = replace(RepairConfig(), **changes)  # pyright: ignore[reportArgumentType]
        return Finding(name, "wrong" if ratio < CLEAR else "doubtful", wrong, repair.flags)
    if not e.contradicted.isdisjoint(kinds):
        why = "parts of the recording contradict each other"
        return Finding(name, "unknown", f"Cannot be known from these frames: {why}.")
    if is_vague:
        why = "there is too little motion"
        return Finding(name, "unknown", f"Cannot be known from these frames: {why}.")
    return Finding(name, "ok", right)


def intrinsics_findings(e: Explanation, camera: Camera, lens: Camera | None) -> list[Finding]:
    """Findings on the intrinsics; of ``lens`` see ``fit_findings``.

    Where another principal point is advised, nothing is said about half a pixel of it.
    """
    findings = [_focal_finding(e, camera, lens), _centre_finding(e, camera)]
    if not {"cx", "cy"} & e.repair.changes.keys():
        findings.append(_pixel_centre_finding(e))
    return findings


def _focal_finding(e: Explanation, camera: Camera, lens: Camera | None) -> Finding:
    repair = e.repair
    uncertainty = e.fits["focal length"].uncertainty
    wrong = (
        f"The focal lengths are wrong: fx {camera.fx:.1f}, fy {camera.fy:.1f}, but the depth "
        f"images give fx {repair.fx:.1f}, fy {repair.fy:.1f}"
    )
    if (repair.fx, repair.fy) == (camera.fy, camera.fx):
        wrong += ": they are exchanged"
    elif "intrinsics size" in e.adopted:
        times = camera.fx / repair.fx
        wrong += f": the intrinsics are those of images {times:.3g} times as large"
    of_lens = ""
    if lens:
        of_lens = f" without distortion; the lens has {lens.fx:.1f} and {lens.fy:.1f}"
    return correction_finding(
        e,
        "focal length",
        fields=("fx", "fy"),
        kinds=("focal length", "fx / fy", "intrinsics size"),
        wrong=f"{wrong}.",
        right=f"The focal lengths fit (fx {camera.fx:.1f}, fy {camera.fy:.1f}{of_lens}, "
        f"± {100 * uncertainty:.1f} %).",
        is_vague=not uncertainty <= _VAGUE_FOCAL,
    )


def _centre_finding(e: Explanation, camera: Camera) -> Finding:
    repair = e.repair
    uncertainty = e.fits["principal point"].uncertainty
    wrong = (
        f"The principal point is wrong: {camera.cx:.1f}, {camera.cy:.1f}, but the depth images "
        f"give {repair.cx:.1f}, {repair.cy:.1f}"
    )
    if (repair.cx, repair.cy) == (camera.cy, camera.cx):
        wrong += ": cx and cy are exchanged"
    return correction_finding(
        e,
        "principal point",
        fields=("cx", "cy"),
        kinds=("principal point",),
        wrong=f"{wrong}.",
        right=f"The principal point fits (cx {camera.cx:.1f}, cy {camera.cy:.1f}, "
        f"± {uncertainty:.1f} pixels).",
        is_vague=not uncertainty <= _VAGUE_CENTRE * camera.width,
    )


def _pixel_centre_finding(e: Explanation) -> Finding:
    """Whether the centre of the first pixel is 0.5, as for all readers, or 0."""
    shift = e.repair.pixel_shift
    uncertainty = e.fits["principal point"].uncertainty
    size, centre = ("small", "0") if shift > 0 else ("large", "1")
    if not shift and not uncertainty < _HALF_PIXEL:
        text = "Half a pixel makes no measurable difference in these frames."
        return Finding("pixel centres", "unknown", text)
    return correction_finding(
        e,
        "pixel centres",
        fields=("pixel_shift",),
        kinds=("principal point",),
        wrong=f"cx and cy are half a pixel too {size}: the intrinsics count the centre of the "
        f"first pixel as {centre}, and here it is 0.5.",
        right="cx and cy are right within half a pixel.",
        is_vague=False,
    )
