"""From frame to frame: depth agreement, motion, exposure, sharpness, repeated images; and the findings on them."""

import itertools
from collections import abc
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from ...config import RepairConfig
from ...data.adjust.poses import reread_poses
from ...drawing.page import PageGraph, page_graph
from ...geometry import se3
from .fit import CalibrationCorrection, FitData, reproject
from .report import Finding
from .sample import Sample

_AGREES_FOR_COLOUR = 0.02
_USABLE_GREY = (12, 243)
_PART = 64


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
    same_colour: Bool[np.ndarray, " F"]
    """Whether every pixel of the colour image is that of the next one."""
    same_depth: Bool[np.ndarray, " F"]


def measure_over_frames(
    sample: Sample, interpretation: RepairConfig, correction: CalibrationCorrection, *, posed: bool = True
) -> OverFrames:
    """Compare every frame with the next under the adopted interpretation and correction.

    Without poses (``posed`` False) only the images are compared; what needs poses is NaN.
    """
    frames, there = sample.frames, sample.by_place
    n = len(frames)
    out = {name: np.full(n, np.nan) for name in ("error", "turned_deg", "moved_m", "gain_stops")}
    same_colour, same_depth = np.zeros(n, bool), np.zeros(n, bool)
    with_next = [i for i, f in enumerate(frames) if f.place + 1 in there]
    poses = reread_poses(sample.stored_poses, interpretation)
    for i in with_next:
        a, b = frames[i], there[frames[i].place + 1]
        same_colour[i], same_depth[i] = a.colour_hash == b.colour_hash, a.depth_hash == b.depth_hash
    for k in range(0, len(with_next) if posed else 0, _PART):
        part = with_next[k : k + _PART]
        data = FitData.of(sample, [(frames[i].place, frames[i].place + 1) for i in part], interpretation)
        reprojected = reproject(data, correction)
        for j, i in enumerate(part):
            known = reprojected.known[j]
            a, b = frames[i], there[frames[i].place + 1]
            T = se3.inverse(poses[b.place]) @ poses[a.place]
            out["turned_deg"][i] = float(se3.rotation_angle(T[:3, :3]).rad2deg())
            out["moved_m"][i] = float(T[:3, 3].norm())
            if int(known.sum()) < 50:
                continue
            r = reprojected.residual[j].abs()
            out["error"][i] = float(r[known].median())
            out["gain_stops"][i] = _gain(a.grey, b.grey, data, reprojected.uv_b[j], j, known & (r < _AGREES_FOR_COLOUR))
    return OverFrames(
        number=np.array([f.number for f in frames], dtype=np.int64),
        **out,
        sharpness=_relative([f.sharpness for f in frames]),
        missing=np.array([f.missing for f in frames]),
        same_colour=same_colour,
        same_depth=same_depth,
    )


def graphs_of(over: OverFrames) -> list[PageGraph]:
    """Each quantity over the frames that was measured at least once."""
    series = [
        ("Depth difference to the next frame", 100 * over.error, "% of depth"),
        ("Rotation to the next frame", over.turned_deg, "degrees"),
        ("Step to the next frame", 100 * over.moved_m, "cm"),
        ("Pixels without depth", 100 * over.missing, "%"),
        ("Brightness of the same points, next / this frame", over.gain_stops, "stops"),
        ("Sharpness beside the neighbours'", over.sharpness, "of their median"),
    ]
    return [
        page_graph(title, over.number, {title: values}, x_label="frame", y_label=unit)
        for title, values, unit in series
        if np.isfinite(values).any()
    ]


def gains(
    sample: Sample, pairs: abc.Sequence[tuple[int, int]], data: FitData, correction: CalibrationCorrection
) -> Float[np.ndarray, " P"]:
    """Brightness of the same points in the second / first frame of each pair, log2; NaN if too few points agree."""
    reprojected, there = reproject(data, correction), sample.by_place
    agrees = reprojected.known & (reprojected.residual.abs() < _AGREES_FOR_COLOUR)
    return np.array(
        [_gain(there[a].grey, there[b].grey, data, reprojected.uv_b[j], j, agrees[j]) for j, (a, b) in enumerate(pairs)]
    )


def _gain(grey_a, grey_b, data: FitData, uv_b: torch.Tensor, j: int, known: torch.Tensor) -> float:
    """Median log2 ratio of the grey levels of the points that agree, without those near black or white."""
    if int(known.sum()) < 50:
        return float("nan")
    a, b = (_look_up(grey, uv[known], data.camera.width) for grey, uv in ((grey_a, data.uv_a[j]), (grey_b, uv_b)))
    low, high = _USABLE_GREY
    good = (a > low) & (a < high) & (b > low) & (b < high)
    return float(np.median(np.log2(b[good] / a[good]))) if good.sum() >= 30 else float("nan")


def _look_up(grey: np.ndarray, uv: torch.Tensor, depth_width: int) -> np.ndarray:
    scale = grey.shape[1] / depth_width
    i, j = ((uv[:, k].numpy() * scale).astype(int) for k in (0, 1))
    return grey[np.clip(j, 0, grey.shape[0] - 1), np.clip(i, 0, grey.shape[1] - 1)].astype(np.float64)


def _relative(values: list[float], reach: int = 5) -> np.ndarray:
    """Values divided by the median of their neighbours."""
    array = np.array(values)
    around = [np.median(array[max(0, i - reach) : i + reach + 1]) for i in range(len(array))]
    return array / np.maximum(np.array(around), 1e-6)


_JUMP_BASE_DEG, _JUMP_BASE_M = 1.0, 0.03
"""Shorter steps are not jumps."""
_JUMP_OF_MEDIAN = 1.5
"""A jump is longer than this many times the median of the steps around, ..."""
_JUMP_ERROR, _JUMP_ERROR_OF_USUAL = 0.01, 4.0
"""... and depth then differs by this share and this many times the usual difference; the worst of 250 steps of a
hand-held Kinect differs by 0.6 per cent, twice the usual."""
_JUMP_UNSEEN = 4.0
"""If two frames have nothing in common, a step is a jump if it is at least this many times the median."""
STEP_STOPS, SPREAD_STOPS = 0.3, 1.0
"""Changes of brightness that are reported, log2: between neighbours (a hand-held Kinect with automatic exposure: 0.19
at most), and between frames up to 30 apart (the same: 0.68)."""
FIT_STOPS = 0.15
"""From this difference within 30 frames on, fitted exposures gain: 0.7 dB at 0.19, nothing at 0.01."""
_BLURRED = 0.3
"""Share of the neighbours' sharpness below which a frame is blurred; the worst of 250 frames of a hand-held Kinect has
0.38."""
_STILL_DEG, _STILL_M = 0.1, 0.002
_NAMED = 12
"""Largest number of frames that a finding names."""


def find_jumps(over: OverFrames) -> tuple[list[int], list[int]]:
    """Frames far from both neighbours, and frames after which the path continues at another place."""
    step = np.maximum(over.turned_deg / _JUMP_BASE_DEG, over.moved_m / _JUMP_BASE_M)
    usual_error = float(np.nanmedian(over.error)) if np.isfinite(over.error).any() else 0.0
    frozen = over.same_depth | np.roll(over.same_depth, 1)  # there depth cannot confirm poses
    jumps = set()
    for i in np.flatnonzero(np.isfinite(step)):
        around = step[max(0, i - 10) : i + 11]
        times = step[i] / max(np.nanmedian(around), 1e-9)
        disagrees = over.error[i] > max(_JUMP_ERROR, _JUMP_ERROR_OF_USUAL * usual_error) and times > _JUMP_OF_MEDIAN
        unseen = np.isnan(over.error[i]) and times > _JUMP_UNSEEN
        if step[i] > 1 and (disagrees or unseen) and not frozen[i]:
            jumps.add(int(i))
    alone = sorted(int(over.number[i + 1]) for i in jumps if i + 1 in jumps)
    cuts = sorted(int(over.number[i]) for i in jumps if i + 1 not in jumps and i - 1 not in jumps)
    return alone, cuts


def jump_finding(over: OverFrames, alone: abc.Sequence[int], cuts: abc.Sequence[int], repair: str) -> Finding:
    """Finding: do the poses jump where the depth images do not?"""
    turned, moved = (float(np.nanmax(x)) if np.isfinite(x).any() else 0.0 for x in (over.turned_deg, over.moved_m))
    numbers = {"largest_turn_deg": turned, "largest_step_m": moved, "jumps": float(len(alone) + len(cuts))}
    extent = f"steps of at most {turned:.1f} degrees and {100 * moved:.1f} cm"
    if not alone and not cuts:
        return Finding("pose jumps", "ok", f"The path is continuous: {extent}.", numbers)
    parts = [f"frame {_list(alone)} is off the path of its neighbours"] * bool(alone)
    parts += [f"the path is interrupted after frame {_list(cuts)}"] * bool(cuts)
    text = f"{' and '.join(parts).capitalize()} ({extent}), but the depth images do not change with it."
    return Finding("pose jumps", "wrong", text, numbers, repair)


def longest_piece(cuts: abc.Sequence[int], length: int) -> tuple[int, int]:
    """First and one past the last frame of the longest piece between cuts (a cut lies after its frame)."""
    ends = [0, *(c + 1 for c in cuts), length]
    return max(itertools.pairwise(ends), key=lambda piece: piece[1] - piece[0])


def motion_finding(over: OverFrames) -> Finding | None:
    """Finding if the poses do not move; else None."""
    if not np.isfinite(over.turned_deg).any() or len(over.number) < 3:
        return None
    if np.nansum(over.turned_deg) > 1 or np.nansum(over.moved_m) > 0.02:
        return None
    if bool(over.same_colour[:-1].all()):
        text = "All poses are the same, and so are the images: nothing can be checked."
        return Finding("pose motion", "doubtful", text)
    repair = "give a trajectory that belongs to this recording"
    return Finding("pose motion", "wrong", "All poses are the same, but the images differ.", repair=repair)


def exposure_finding(over: OverFrames, far_gains: np.ndarray) -> Finding:
    """Finding: do the same points keep their brightness?"""
    known = np.isfinite(over.gain_stops)
    step = float(np.abs(over.gain_stops[known]).max(initial=0.0))
    spread = float(np.nanmax(np.abs(far_gains), initial=0.0))
    numbers = {"largest_step_stops": step, "largest_difference_stops": spread}
    text = (
        f"The brightness of the same points differs by at most {step:.2f} stops from frame to frame and {spread:.2f} "
        "within 30 frames"
    )
    if step < STEP_STOPS and spread < SPREAD_STOPS:
        hint = "; map with --optim.fit-exposure" if spread > FIT_STOPS else ""
        return Finding("exposure", "ok", f"{text}{hint}.", numbers)
    worst = over.number[known][np.argsort(-np.abs(over.gain_stops[known]))][:3]
    repair = (
        "map with --optim.fit-exposure, or the map will show stripes of different brightness; lock exposure and white "
        "balance when recording"
    )
    return Finding(
        "exposure", "doubtful", f"{text}, most after frame {_list(sorted(worst.tolist()))}.", numbers, repair
    )


def blurred_frames(over: OverFrames) -> list[int]:
    """Frames that are much less sharp than their neighbours."""
    return [int(p) for p, s in zip(over.number, over.sharpness, strict=True) if s < _BLURRED]


def repeated_frames(over: OverFrames, *, posed: bool = True) -> dict[int, str]:
    """Frame number -> "both", "colour" or "depth", where every pixel is that of the frame before.

    With poses (``posed``) only frames before which the camera moved.
    """
    moved = (over.turned_deg > _STILL_DEG) | (over.moved_m > _STILL_M) | (not posed)
    colour, depth = over.same_colour, over.same_depth
    found = {int(over.number[i + 1]): (colour[i], depth[i]) for i in np.flatnonzero((colour | depth) & moved)}
    return {n: "both" if c and d else "colour" if c else "depth" for n, (c, d) in found.items()}


def sharpness_finding(over: OverFrames, blurred: abc.Sequence[int]) -> Finding:
    """Finding: are single frames blurred?"""
    least = float(over.sharpness.min(initial=1.0))
    numbers = {"least_relative_sharpness": least, "blurred": float(len(blurred))}
    if not blurred:
        text = "No frame is much less sharp than its neighbours"
        return Finding("sharpness", "ok", f"{text} (the least sharp has {least:.2f} of their sharpness).", numbers)
    text = f"More blurred than their neighbours: frame {_list(blurred)}."
    return Finding("sharpness", "doubtful", text, numbers, RepairConfig(skip=tuple(blurred)).flags)


def frozen_finding(over: OverFrames, frozen: abc.Mapping[int, str], *, posed: bool = True) -> Finding:
    """Finding: are images repeated while the camera moves?

    Args:
        over: Measurements from frame to frame.
        frozen: Result of ``repeated_frames``.
        posed: Whether there are poses, which say that the camera moved.
    """
    numbers = {"frozen": float(len(frozen)), "repeated": float((over.same_colour | over.same_depth).sum())}
    if not frozen:
        text = "No image is repeated while the poses move." if posed else "No image repeats the one before."
        return Finding("frozen frames", "ok", text, numbers)
    images = {"both": "colour and depth", "colour": "only colour", "depth": "only depth"}
    kinds = {kind: [n for n in frozen if frozen[n] == kind] for kind in images}
    which = "; ".join(f"{images[kind]} of frame {_list(those)}" for kind, those in kinds.items() if those)
    moved = "although the pose changed" if posed else "(whether the camera moved cannot be known without poses)"
    text = f"The image of the previous frame is repeated pixel by pixel {moved}: {which}."
    repair = RepairConfig(skip=tuple(frozen)).flags
    return Finding("frozen frames", "wrong" if posed else "doubtful", text, numbers, repair)


def _list(frames: abc.Sequence[int]) -> str:
    named = ", ".join(map(str, frames[:_NAMED]))
    return f"{named} and {len(frames) - _NAMED} more" if len(frames) > _NAMED else named
