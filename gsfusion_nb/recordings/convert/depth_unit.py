"""How many stored units are a metre: what the files, the sensor's name, the depths and the poses say about it.

A 16-bit depth image does not say its unit. Recordings in the TUM layout have 5000 units a metre (the benchmark's own)
or 1000 (most cameras' software). One piece of evidence can be wrong, so all of them are compared, and where they leave
more than one unit, the user is asked.
"""

import math
import re
from collections import abc
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...data.adjust.depth_agreement import depth_consistency, depth_pair, relative_poses
from ...data.recorded.files import own_names
from ...data.sequence import BadFrameError
from ...files import SequenceError, read_text
from ...geometry import se3
from ...types import Camera
from .recording import read_depth_file

USUAL = (1000.0, 5000.0)
NEAREST_M, FARTHEST_MEDIAN_M, FARTHEST_M = 0.2, 5.0, 12.0
"""Depths of a hand-held camera: the first percentile is not nearer, the median and the 95th percentile not farther."""
NEAREST_TUM_M = 0.35
"""5000 units a metre come from cameras of the Kinect's kind, which measure nothing nearer."""
_CLEARLY = 0.05
"""A unit fits the poses if it scores higher than every other by this much (0..1)."""
_STATED = re.compile(
    r"\b(?:DepthMapFactor|depth_map_factor|png_depth_scale|depth_factor|depth_scale|depthScale)\b"
    r"[\"']?\s*[:=]\s*([0-9.eE+-]+)"
)
_CAMERAS = (
    (r"realsense|\bd4[0-9]5i?\b|\bl515\b|\bsr300\b", "an Intel RealSense", (1000.0, 4000.0, 10000.0)),
    (r"azure|\bk4a\b|kinect[ _]?(v2|2|dk)", "a time-of-flight Kinect", (1000.0,)),
    (r"orbbec|\bastra\b|\bfemto\b", "an Orbbec camera", (1000.0,)),
    (r"\bzed[2mi]?\b|record3d|arkit|\blidar\b", "a camera that stores millimetres", (1000.0,)),
    (r"freiburg[123]|\bfr[123]_|rgbd_bonn|eth3d", "a benchmark with 5000 units a metre", (5000.0,)),
)
"""Names in a folder's name or its notes, what they mean, and the units a metre that are usual there."""
_NOTES = ("README*", "*.md", "*.yaml", "*.yml", "*.json", "cam*.txt", "calib*.txt", "intrinsics*.txt")


@dataclass(frozen=True)
class DepthUnit:
    """The stored value of one metre, and why."""

    scale: float
    sentence: str


def find_depth_unit(
    folder: Path, stored: abc.Sequence[np.ndarray], fits_poses: abc.Mapping[float, float] | None = None
) -> DepthUnit:
    """Infer the stored value of one metre.

    Args:
        folder: Of the recording; its name and its notes are read.
        stored: Some depth images as stored, 0 = missing. [H, W] each
        fits_poses: Units a metre -> how well depths then agree under the poses, 0..1; None without poses.

    Raises:
        SequenceError: the evidence leaves several units or none; the message lists it and asks for the option.
    """
    text = "\n".join([*own_names(folder), *_notes(folder)])
    camera = next((c for c in _CAMERAS if re.search(c[0], text, re.IGNORECASE)), None)
    stated = _stated(text)
    values = np.concatenate([image[image > 0].ravel() for image in stored] or [np.zeros(0)])
    if not len(values):
        raise SequenceError(f"{folder}: the depth images tried hold no depth; give --depth-scale, units per metre")
    tried = sorted({*USUAL, *(camera[2] if camera else ()), *((1.0,) if _has_fractions(values) else ())})
    near, middle, far = (float(np.percentile(values, q)) for q in (1, 50, 95))
    plausible = [s for s in tried if _is_plausible(s, near, middle, far)]
    evidence = [_range_words(s, near, middle, far, s in plausible) for s in tried]
    left = plausible
    if camera:
        evidence.insert(0, f"the folder names {camera[1]} ({' or '.join(f'{s:g}' for s in camera[2])})")
        left = [s for s in left if s in camera[2]] or left
    if len(left) > 1 and 5000.0 in left and _are_fives(values):
        evidence.append("all stored values are multiples of 5, as of millimetres written with 5000 a metre")
        left = [5000.0]
    fitting = _clearly_best(fits_poses or {})
    if fitting:
        evidence.insert(0, f"under the poses, depth images agree best with {fitting:g}")
        left = [fitting]
    if stated:
        evidence.insert(0, f"the recording's notes say {stated:g}")
        left = [stated]
    if 1000.0 in left and camera and 1000.0 in camera[2]:
        left = [1000.0]  # what the cameras' software writes; the finer units only where millimetres are impossible
    if len(left) != 1:
        raise SequenceError(
            f"{folder}: the unit of depth cannot be known from the files: {'; '.join(evidence)}; "
            "give --depth-scale, the stored value of one metre"
        )
    return DepthUnit(left[0], f"depth was taken as {left[0]:g} units a metre, because {'; '.join(evidence)}")


def plausible_range(scale: float, values: np.ndarray) -> bool:
    """Whether the stored values are depths of a hand-held camera in this unit."""
    return not len(values) or _is_plausible(scale, *(float(np.percentile(values, q)) for q in (1, 50, 95)))


def _is_plausible(scale: float, near: float, middle: float, far: float) -> bool:
    nearest = NEAREST_TUM_M if scale == 5000.0 else NEAREST_M
    return near >= nearest * scale and middle <= FARTHEST_MEDIAN_M * scale and far <= FARTHEST_M * scale


def _range_words(scale: float, near: float, middle: float, far: float, plausible: bool) -> str:
    return (
        f"with {scale:g} the depths are {near / scale:.2f} to {far / scale:.2f} m, median {middle / scale:.2f} m, "
        f"which is {'plausible' if plausible else 'not plausible'}"
    )


def _are_fives(values: np.ndarray) -> bool:
    some = np.unique(values[:: max(1, len(values) // 100_000)])
    return len(some) > 50 and bool((np.mod(some, 5) == 0).mean() > 0.999)


def _has_fractions(values: np.ndarray) -> bool:
    return bool((np.mod(values[:10_000], 1) != 0).any())


def _clearly_best(fits_poses: abc.Mapping[float, float]) -> float:
    """The unit that fits the poses clearly better than the others; 0 if there is none."""
    ordered = sorted(fits_poses, key=lambda s: -fits_poses[s])
    clear = len(ordered) > 1 and fits_poses[ordered[0]] > fits_poses[ordered[1]] + _CLEARLY
    return ordered[0] if clear else 0.0


def _stated(text: str) -> float:
    """Units a metre that a note states; metres a unit are inverted. 0 if none does."""
    match = _STATED.search(text)
    try:
        value = float(match[1]) if match else 0.0
    except ValueError:
        return 0.0
    value = 1 / value if 0 < value < 1 else value
    return value if math.isfinite(value) and value > 0 else 0.0


def _notes(folder: Path) -> list[str]:
    """Beginnings of the notes and calibrations in a folder; those that cannot be read are left out."""
    found = []
    for file in sorted({f for pattern in _NOTES for f in folder.glob(pattern) if f.is_file()})[:8]:
        try:
            found.append(read_text(file, "notes")[:4000])
        except (SequenceError, OSError):
            continue
    return found


SCALES = (0.0, 1.0, 256.0, 1000.0, 4000.0, 5000.0, 6553.5, 10000.0)
"""Units a metre that are tried. 0 leaves the camera's motion out: a unit that is right must do better than that."""
_PAIRS = 6
_REACH = 60
"""Frames between the two of a pair, at most."""
_MOVED_M = 0.1
"""Motion that tells one unit from another."""


def fits_poses(
    files: abc.Sequence[Path], poses: abc.Sequence[Float[Tensor, "4 4"] | None], camera: Camera
) -> dict[float, float]:
    """Units a metre -> share of the points, weighted by how well they agree, over a few pairs of frames.

    Empty where no pair of frames with poses and depth moved by 10 cm. Distortion is ignored.

    Args:
        files: Depth images in order.
        poses: Camera-to-world pose of each, metres; None where it is unknown.
        camera: Camera of the depth images.
    """
    scores = []
    for first in sorted({int(i) for i in np.linspace(0, max(len(files) - 2, 0), _PAIRS)}):
        second = _partner(poses, first)
        T_a, T_b = poses[first], poses[second] if second else None
        if T_a is None or T_b is None:
            continue
        try:
            depth_a, depth_b = (torch.from_numpy(read_depth_file(files[i], 1.0)) for i in (first, second))
        except BadFrameError:
            continue
        fitted = camera.resized(depth_a.shape[1], depth_a.shape[0])
        T_ba = relative_poses(T_a.double()[None], T_b.double()[None]).expand(len(SCALES), 4, 4).clone()
        T_ba[:, :3, 3] *= torch.tensor(SCALES, dtype=torch.float64)[:, None]
        scores.append(depth_consistency(depth_pair(depth_a, depth_b, fitted, step=8), T_ba).score)
    return dict(zip(SCALES, torch.stack(scores).mean(0).tolist(), strict=True)) if scores else {}


def some_depths(files: abc.Sequence[Path], n: int = 8) -> list[np.ndarray]:
    """A few depth images as stored, spread over the recording; damaged ones are left out."""
    found = []
    for i in sorted({int(i) for i in np.linspace(0, len(files) - 1, n)}):
        try:
            found.append(read_depth_file(files[i], 1.0))
        except BadFrameError:
            continue
    return found


def _partner(poses: abc.Sequence[Float[Tensor, "4 4"] | None], first: int) -> int:
    """The next frame that moved far enough; 0 if there is none."""
    T = poses[first]
    for i in range(first + 1, min(first + 1 + _REACH, len(poses))):
        other = poses[i]
        if T is not None and other is not None:
            relative = se3.inverse(T.double()) @ other.double()
            if float(relative[:3, 3].norm()) >= _MOVED_M:
                return i
    return 0
