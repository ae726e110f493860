"""From frame to frame: depth agreement, motion, exposure, sharpness, repeated images; and the
findings on them."""

import itertools
from collections import abc
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from ...config import DataConfig, RepairConfig
from ...data.adjust.poses import reread_poses
from ...data.adjust.reprojection import FEWEST_GREYS, gain_stops, greys_at, is_usable_grey
from ...data.adjust.steps import STILL_DEG, STILL_M, find_jumps
from ...drawing.page import PageGraph, page_graph
from ...geometry import se3
from ...types import Camera
from .agreement import CalibrationCorrection, FitData, reproject
from .report import Finding, flags_of
from .sample import Sample

_AGREES_FOR_COLOUR = 0.02
_SAME_GREY = 10.0
"""Grey levels by which two pictures of a point may differ."""
_PART = 64
_FEWEST_POINTS = 50
"""Of a pair of frames, to compare them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OverFrames:
    """One value per frame read, for the step to the next frame; NaN if that was not read."""

    number: Int[np.ndarray, " F"]
    """Frame number in the recording."""
    error: Float[np.ndarray, " F"]
    """Median relative depth difference over the points that fall on a valid depth."""
    turned_deg: Float[np.ndarray, " F"]
    moved_m: Float[np.ndarray, " F"]
    gain_stops: Float[np.ndarray, " F"]
    """Brightness of the same points in the next frame / in this frame, log2."""
    sharpness: Float[np.ndarray, " F"]
    """Divided by the median of the ten frames around it."""
    missing: Float[np.ndarray, " F"]
    same: Bool[np.ndarray, " F"]
    """Whether every pixel of the colour or of the depth image is that of the next one."""


def measure_over_frames(
    sample: Sample,
    interpretation: RepairConfig,
    correction: CalibrationCorrection,
    *,
    has_poses: bool = True,
) -> OverFrames:
    """Compare every frame with the next under the adopted interpretation and correction.

    Without poses (``has_poses`` False) only the images are compared; what needs poses is NaN.
    """
    frames = sample.frames
    by_place = sample.by_place
    columns = {
        name: np.full(len(frames), np.nan)
        for name in ("error", "turned_deg", "moved_m", "gain_stops")
    }
    same = np.zeros(len(frames), bool)
    with_next = [
        (i, f, by_place[f.place + 1]) for i, f in enumerate(frames) if f.place + 1 in by_place
    ]
    poses = reread_poses(sample.stored_poses, interpretation)
    for i, a, b in with_next:
        same[i] = b.repeats
        T = se3.inverse(poses[b.place]) @ poses[a.place]
        if has_poses:
            columns["turned_deg"][i] = float(se3.rotation_angle(T[:3, :3]).rad2deg())
            columns["moved_m"][i] = float(T[:3, 3].norm())
    for k in range(0, len(with_next) if has_poses else 0, _PART):
        part = with_next[k : k + _PART]
        pairs = [(a.place, b.place) for _, a, b in part]
        data = FitData.of(sample, pairs, interpretation)
        stops, errors, _ = gains(sample, pairs, data, correction)
        for j, (i, _, _) in enumerate(part):
            columns["gain_stops"][i] = stops[j]
            columns["error"][i] = errors[j]
    return OverFrames(
        number=np.array([f.number for f in frames], dtype=np.int64),
        **columns,
        sharpness=_relative([f.sharpness for f in frames]),
        missing=np.array([f.missing for f in frames]),
        same=same,
    )


def graphs_of(measures: OverFrames) -> list[PageGraph]:
    """Each quantity over the frames that was measured at least once."""
    series = [
        ("Depth difference to the next frame", 100 * measures.error, "% of depth"),
        ("Rotation to the next frame", measures.turned_deg, "degrees"),
        ("Step to the next frame", 100 * measures.moved_m, "cm"),
        ("Pixels without depth", 100 * measures.missing, "%"),
        ("Brightness of the same points, next / this frame", measures.gain_stops, "stops"),
        ("Sharpness beside the neighbours'", measures.sharpness, "of their median"),
    ]
    return [
        page_graph(title, measures.number, {title: values}, x_label="frame", y_label=unit)
        for title, values, unit in series
        if np.isfinite(values).any()
    ]


def gains(
    sample: Sample,
    pairs: abc.Sequence[tuple[int, int]],
    data: FitData,
    correction: CalibrationCorrection,
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Brightness of the same points in the second / first frame of each pair, log2, without those
    near black or white; the median relative difference of their depths; and the share of all points
    that agree in depth and, apart from that ratio, in brightness.

    With too few points that meet a depth the first two are NaN. The share is then 0 where the
    points leave the image, and NaN, not measured, where they meet pixels without depth."""
    uv_b, residual, all_known = reproject(data, correction)
    by_place = sample.by_place
    residual = residual.abs()
    stops = np.full(len(pairs), np.nan)
    errors = np.full(len(pairs), np.nan)
    shares = np.zeros(len(pairs))
    for j, (first, second) in enumerate(pairs):
        is_measured = all_known[j]
        if int(is_measured.sum()) < _FEWEST_POINTS:
            is_inside = _is_inside(uv_b[j], data.camera) & (data.depth_a[j] > 0)
            if int(is_inside.sum()) >= _FEWEST_POINTS:
                shares[j] = np.nan
            continue
        errors[j] = float(residual[j][is_measured].median())
        agrees = is_measured & (residual[j] < _AGREES_FOR_COLOUR)
        a = greys_at(
            by_place[first].grey,
            data.uv_a[j][agrees],
            data.camera.width,
        )
        b = greys_at(
            by_place[second].grey,
            uv_b[j][agrees],
            data.camera.width,
        )
        good = is_usable_grey(a, b)
        if good.sum() >= FEWEST_GREYS:
            stops[j] = gain_stops(a[good], b[good])
            shares[j] = (np.abs(b / 2 ** stops[j] - a) < _SAME_GREY).sum() / int(
                (data.depth_a[j] > 0).sum()
            )
    return stops, errors, shares


def _is_inside(
    uv: Float[torch.Tensor, "N 2"],
    camera: Camera,
) -> Bool[torch.Tensor, " N"]:
    return (uv[:, 0] > 0) & (uv[:, 0] < camera.width) & (uv[:, 1] > 0) & (uv[:, 1] < camera.height)


def _relative(values: list[float], reach: int = 5) -> np.ndarray:
    """Values divided by the median of their neighbours."""
    array = np.array(values)
    medians = [np.median(array[max(0, i - reach) : i + reach + 1]) for i in range(len(array))]
    return array / np.maximum(np.array(medians), 1e-6)


STEP_STOPS = 0.3
SPREAD_STOPS = 1.0
"""Changes of brightness that are reported, log2: between neighbours (a hand-held Kinect with
automatic exposure: 0.19 at most), and between frames up to 30 apart (the same: 0.68)."""
FIT_STOPS = 0.15
"""From this difference within 30 frames on, fitted exposures gain: 0.7 dB at 0.19, nothing at
0.01."""
_BLURRED = 0.3
"""Share of the neighbours' sharpness below which a frame is blurred; the worst of 250 frames of a
hand-held Kinect has 0.38."""
_NAMED = 12
"""Largest number of frames that a finding names."""


def _jumps(measures: OverFrames) -> tuple[list[int], list[int]]:
    """Frames far from both neighbours, and frames after which the path continues at another
    place."""
    frozen = measures.same | np.roll(measures.same, 1)
    jumps = find_jumps(measures.turned_deg, measures.moved_m, measures.error, frozen)
    outliers = sorted(int(measures.number[i + 1]) for i in jumps if i + 1 in jumps)
    cuts = sorted(
        int(measures.number[i]) for i in jumps if i + 1 not in jumps and i - 1 not in jumps
    )
    return outliers, cuts


def jump_finding(measures: OverFrames, length: int) -> tuple[DataConfig, Finding]:
    """Finding: do the poses jump where the depth images do not? And the range to keep of ``length``
    frames."""
    outliers, cuts = _jumps(measures)
    most_deg, most_m = (
        float(np.nanmax(x, initial=0.0)) for x in (measures.turned_deg, measures.moved_m)
    )
    extent = f"steps of at most {most_deg:.1f} degrees and {100 * most_m:.1f} cm"
    if not outliers and not cuts:
        return DataConfig(), Finding(
            "pose jumps", "ok", f"No frame is off the path of its neighbours: {extent}."
        )
    piece = DataConfig(repair=RepairConfig(skip=tuple(outliers)))
    if cuts:  # the longest piece between cuts, which lie after their frames
        ends = [0, *(c + 1 for c in cuts), length]
        start, stop = max(itertools.pairwise(ends), key=lambda ends: ends[1] - ends[0])
        piece = replace(piece, start=start, stop=stop)
    parts = [f"frame {_list(outliers)} is off the path of its neighbours"] * bool(outliers)
    parts += [f"the path is interrupted after frame {_list(cuts)}"] * bool(cuts)
    text = (
        f"{' and '.join(parts).capitalize()} ({extent}), but the depth images do not change "
        "with it."
    )
    return piece, Finding("pose jumps", "wrong", text, flags_of(piece))


def exposure_finding(measures: OverFrames, far_gains: np.ndarray) -> Finding:
    """Finding: do the same points keep their brightness?"""
    is_measured = np.isfinite(measures.gain_stops)
    step = float(np.abs(measures.gain_stops[is_measured]).max(initial=0.0))
    far_stops = float(np.nanmax(np.abs(far_gains), initial=0.0))
    text = (
        f"The brightness of the same points differs by at most {step:.2f} stops from frame to "
        f"frame and {far_stops:.2f} within 30 frames."
    )
    if step < STEP_STOPS and far_stops < SPREAD_STOPS:
        hint = " Map with --optim.fit-exposure." if far_stops > FIT_STOPS else ""
        return Finding("exposure", "ok", text + hint)
    repair = "map with --optim.fit-exposure; lock exposure and white balance when recording"
    return Finding("exposure", "doubtful", text, repair)


def image_findings(
    measures: OverFrames, *, has_poses: bool = True
) -> tuple[tuple[int, ...], list[Finding]]:
    """Findings: are single frames blurred, and are images repeated while the camera moves? And the
    frames to leave out.

    Without poses (``has_poses`` False) nothing says that the camera moved.
    """
    least = float(measures.sharpness.min(initial=1.0))
    blurred_frames = measures.number[measures.sharpness < _BLURRED].tolist()
    text = (
        f"No frame is much less sharp than its neighbours (the least sharp has {least:.2f} of "
        "their sharpness)."
    )
    sharp = Finding("sharpness", "ok", text)
    if blurred_frames:
        text = f"More blurred than their neighbours: frame {_list(blurred_frames)}."
        flags = RepairConfig(skip=tuple(blurred_frames))
        sharp = Finding("sharpness", "doubtful", text, flags.flags)
    has_moved = (measures.turned_deg > STILL_DEG) | (measures.moved_m > STILL_M) | (not has_poses)
    frozen = [int(measures.number[i + 1]) for i in np.flatnonzero(measures.same & has_moved)]
    live = Finding("frozen frames", "ok", "No image is repeated while the camera moves.")
    if frozen:
        text = (
            "Colour or depth is that of the previous frame, pixel by pixel, in frame "
            f"{_list(frozen)}"
        )
        text += (
            ", although the pose changed."
            if has_poses
            else "; whether the camera moved cannot be known without poses."
        )
        flags = RepairConfig(skip=tuple(frozen)).flags
        live = Finding("frozen frames", "wrong" if has_poses else "doubtful", text, flags)
    return tuple(sorted({*blurred_frames, *frozen})), [sharp, live]


def _list(frames: abc.Sequence[int]) -> str:
    numbers = ", ".join(map(str, frames[:_NAMED]))
    return f"{numbers} and {len(frames) - _NAMED} more" if len(frames) > _NAMED else numbers
