"""Findings on focal lengths, principal point and pixel centres, from the best explanation."""

import math

from ...config import RepairConfig
from ...types import Camera
from .corrections import CLEAR
from .explain import Explanation, repair_fields
from .findings import Finding

_VAGUE_FOCAL, _VAGUE_CENTRE = 0.1, 8.0
"""Uncertainties, a share and 640ths of the image width, from which on the intrinsics cannot be known."""
_IMITATED = "; what the motion does to the images (a time offset, a rolling shutter) can look the same"


def intrinsics_findings(e: Explanation, camera: Camera) -> list[Finding]:
    """Findings on focal lengths, principal point and pixel centres."""
    c = e.corrected.correction
    fields = repair_fields(c, camera, e.interpretation)
    focal = {k: v for k, v in fields.items() if k in ("fx", "fy")}
    centre = {k: v for k, v in fields.items() if k in ("cx", "cy")}
    return [
        _focal(e, camera, focal, centre),
        _centre(e, camera, {} if _size_is_wrong(e) else centre),
        _pixel_centre(e, fields),
    ]


def _focal(e: Explanation, camera: Camera, focal: dict, centre: dict) -> Finding:
    numbers = {"fx": camera.fx, "fy": camera.fy, **{f"{k}_measured": v for k, v in focal.items()}}
    if not focal:
        fitted = e.corrected.last_fit("focal length")
        doubts = e.unconfirmed.get("focal length", e.unconfirmed.get("fx / fy"))
        if doubts or (fitted and fitted.uncertainty > _VAGUE_FOCAL):
            parts = ", ".join(f"{100 * math.expm1(v):+.1f} %" for v in doubts or ())
            why = f"parts of the recording ask for {parts}{_IMITATED}" if doubts else "too little motion"
            text = f"Whether the focal lengths fit cannot be known from these frames: {why}."
            return Finding(name="focal length", verdict="unknown", numbers=numbers, sentence=text)
        known = f", ± {100 * fitted.uncertainty:.1f} %" if fitted and math.isfinite(fitted.uncertainty) else ""
        return Finding(
            name="focal length",
            verdict="ok",
            numbers=numbers,
            sentence=f"The focal lengths fit (fx {camera.fx:.1f}, fy {camera.fy:.1f}{known}).",
        )
    ratio = min(e.corrected.cost_ratio(k) for k in ("focal length", "fx / fy", "intrinsics size"))
    old, new = f"fx {camera.fx:.1f}, fy {camera.fy:.1f}", f"fx {focal['fx']:.1f}, fy {focal['fy']:.1f}"
    text = f"The focal lengths are wrong: {old}, but the depth images give {new}"
    if focal == {"fx": camera.fy, "fy": camera.fx}:
        text += ": they are exchanged"
    fields = dict(focal)
    if _size_is_wrong(e):
        times = camera.fx / focal["fx"]
        text += (
            f", and the principal point has the same factor: the intrinsics are those of images {times:.3g} times as "
            "large"
        )
        fields |= centre
    return Finding(
        name="focal length",
        verdict="wrong" if ratio < CLEAR else "doubtful",
        numbers=numbers | {"cost_ratio": ratio},
        sentence=f"{text}.",
        repair=RepairConfig(**fields).flags,
    )


def _centre(e: Explanation, camera: Camera, centre: dict) -> Finding:
    numbers = {"cx": camera.cx, "cy": camera.cy, **{f"{k}_measured": v for k, v in centre.items()}}
    if not centre:
        fitted = e.corrected.last_fit("principal point")
        doubts = e.unconfirmed.get("principal point")
        if doubts or (fitted and fitted.uncertainty > _VAGUE_CENTRE * camera.width / 640):
            parts = ", ".join(f"{v:+.0f}" for v in doubts or ())
            why = f"parts of the recording ask for {parts} pixels{_IMITATED}" if doubts else "too little motion"
            text = f"Whether the principal point fits cannot be known from these frames: {why}."
            return Finding(name="principal point", verdict="unknown", numbers=numbers, sentence=text)
        known = f", ± {fitted.uncertainty:.1f} pixels" if fitted and math.isfinite(fitted.uncertainty) else ""
        return Finding(
            name="principal point",
            verdict="ok",
            numbers=numbers,
            sentence=f"The principal point fits (cx {camera.cx:.1f}, cy {camera.cy:.1f}{known}).",
        )
    ratio = e.corrected.cost_ratio("principal point")
    old, new = f"{camera.cx:.1f}, {camera.cy:.1f}", f"{centre['cx']:.1f}, {centre['cy']:.1f}"
    text = f"The principal point is wrong: {old}, but the depth images give {new}"
    if centre == {"cx": camera.cy, "cy": camera.cx}:
        text += ": cx and cy are exchanged"
    return Finding(
        name="principal point",
        verdict="wrong" if ratio < CLEAR else "doubtful",
        numbers=numbers | {"cost_ratio": ratio},
        sentence=f"{text}.",
        repair=RepairConfig(**centre).flags,
    )


def _pixel_centre(e: Explanation, fields: dict) -> Finding:
    shift = fields.get("pixel_shift", 0.0)
    fitted = e.corrected.last_fit("principal point")
    known = fitted.uncertainty if fitted else math.nan
    if shift:
        return Finding(
            name="pixel centres",
            verdict="doubtful",
            numbers={"shift_px": shift, "cost_ratio": e.corrected.cost_ratio("principal point")},
            repair=RepairConfig(pixel_shift=shift).flags,
            sentence=(
                f"cx and cy are half a pixel too {'small' if shift > 0 else 'large'}: the first pixel's centre is "
                f"{'0' if shift > 0 else '0.5'} in the intrinsics, but not for the reader."
            ),
        )
    if not known < 0.4:
        return Finding(
            name="pixel centres",
            verdict="unknown",
            numbers={"known_to_px": known},
            sentence="Half a pixel makes no measurable difference in these frames.",
        )
    return Finding(
        name="pixel centres",
        verdict="ok",
        numbers={"known_to_px": known},
        sentence="cx and cy are right within half a pixel.",
    )


def _size_is_wrong(e: Explanation) -> bool:
    return e.corrected.adopted_fit("intrinsics size") is not None
