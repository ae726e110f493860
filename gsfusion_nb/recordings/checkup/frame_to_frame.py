"""Measurements from frame to frame: depth agreement, motion, exposure, sharpness, frozen images."""

from collections import abc
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from ...config import RepairConfig
from ...data.adjust.poses import reread_poses
from ...geometry import se3
from .geometry_fit import CalibrationCorrection, FitData, reproject
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
    flow_px: Float[np.ndarray, " F"]
    """Median distance by which points move in the image, pixels of the full image."""
    sharpness: Float[np.ndarray, " F"]
    """Divided by the median of the ten frames around it."""
    missing: Float[np.ndarray, " F"]
    brightness: Float[np.ndarray, " F"]
    same_colour: Bool[np.ndarray, " F"]
    """Whether the colour image is the same as the next one."""
    same_depth: Bool[np.ndarray, " F"]


def measure_over_frames(
    sample: Sample, interpretation: RepairConfig, correction: CalibrationCorrection, *, posed: bool = True
) -> OverFrames:
    """Compare every frame with the next under the adopted interpretation and correction.

    Without poses (``posed`` False) only the images are compared; what needs poses is NaN.
    """
    frames, there = sample.frames, sample.by_place
    n = len(frames)
    out = {name: np.full(n, np.nan) for name in ("error", "turned_deg", "moved_m", "gain_stops", "flow_px")}
    same_colour, same_depth = np.zeros(n, bool), np.zeros(n, bool)
    with_next = [i for i, f in enumerate(frames) if f.place + 1 in there]
    poses = reread_poses(sample.stored_poses, interpretation)
    for k in range(0, len(with_next), _PART):
        part = with_next[k : k + _PART]
        pairs = [(frames[i].place, frames[i].place + 1) for i in part]
        for i in part:
            a, b = frames[i], there[frames[i].place + 1]
            same_colour[i] = a.grey.shape == b.grey.shape and int(np.abs(a.grey.astype(np.int16) - b.grey).max()) <= 1
            same_depth[i] = bool(torch.equal(a.depth_m, b.depth_m))
        if not posed:
            continue
        data = FitData.of(sample, pairs, interpretation)
        reprojected = reproject(data, correction)
        shift = (reprojected.uv_b - data.uv_a).norm(dim=-1) * data.thinning
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
            out["flow_px"][i] = float(shift[j][known].median())
            out["gain_stops"][i] = _gain(a.grey, b.grey, data, reprojected.uv_b[j], j, known & (r < _AGREES_FOR_COLOUR))
    return OverFrames(
        number=np.array([f.number for f in frames], dtype=np.int64),
        **out,
        sharpness=_relative([f.sharpness for f in frames]),
        missing=np.array([f.missing for f in frames]),
        brightness=np.array([f.brightness for f in frames]),
        same_colour=same_colour,
        same_depth=same_depth,
    )


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
