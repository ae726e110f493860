"""How many stored units are a metre: what the notes, the sensor's name and the depths say about it.

A 16-bit depth image does not say its unit. Recordings in the TUM layout have 5000 units a metre (the benchmark's own)
or 1000 (most cameras' software). Where the evidence leaves more than one unit, the user is asked; whether the unit fits
the poses, the check of the converted recording tells.
"""

import math
import re
from collections import abc
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...data.recorded.files import own_names
from ...data.sequence import BadFrameError, SequenceError
from ...files import read_text
from .recording import read_depth_file

USUAL = (1000.0, 5000.0)
NEAREST_M, FARTHEST_MEDIAN_M, FARTHEST_M = 0.2, 5.0, 12.0
"""Depths of a hand-held camera: the first percentile is not nearer, the median and the 95th percentile not farther."""
NEAREST_TUM_M = 0.35
"""5000 units a metre come from cameras of the Kinect's kind, which measure nothing nearer."""
_STATED = re.compile(
    r"\b(?:DepthMapFactor|depth_map_factor|png_depth_scale|depth_factor|depth_scale|depthScale)\b"
    r"[\"']?\s*[:=]\s*([0-9.eE+-]+)"
)
_CAMERAS = (
    (
        r"realsense|\bd4[0-9]5i?\b|\bl515\b|azure|\bk4a\b|kinect[ _]?(v2|2|dk)|orbbec|\bzed\b|record3d|arkit|lidar",
        1000.0,
    ),
    (r"freiburg[123]|\bfr[123]_|rgbd_bonn|eth3d", 5000.0),
)
"""Names in a folder's name or its notes, and the units a metre that are usual there."""
_NOTES = ("README*", "*.md", "*.yaml", "*.yml", "*.json", "cam*.txt", "calib*.txt", "intrinsics*.txt")


@dataclass(frozen=True)
class DepthUnit:
    """The stored value of one metre, and why."""

    scale: float
    sentence: str


def find_depth_unit(folder: Path, stored: abc.Sequence[np.ndarray]) -> DepthUnit:
    """Infer the stored value of one metre.

    Args:
        folder: Of the recording; its name and its notes are read.
        stored: Some depth images as stored, 0 = missing. [H, W] each

    Raises:
        SequenceError: the evidence leaves several units or none; the message asks for the option.
    """
    text = "\n".join([*own_names(folder), *_notes(folder)])
    values = np.concatenate([image[image > 0].ravel() for image in stored] or [np.zeros(0)])
    if not len(values):
        raise SequenceError(f"{folder}: the depth images tried hold no depth; give --depth-scale, units per metre")
    plausible = [s for s in (*USUAL, *((1.0,) if _has_fractions(values) else ())) if plausible_range(s, values)]
    named = [s for pattern, s in _CAMERAS if s in plausible and re.search(pattern, text, re.IGNORECASE)]
    evidence = [
        ([_stated(text)] if _stated(text) else [], "the recording's notes say so"),
        (named, "the folder names a camera or a data set in which it is usual"),
        (plausible, "it gives depths of a hand-held camera"),
    ]
    scales, why = next((e for e in evidence if len(e[0]) == 1), ([], ""))
    if not scales:
        middle = float(np.median(values))
        medians = ", ".join(f"{middle / s:.2f} m with {s:g}" for s in USUAL)
        raise SequenceError(
            f"{folder}: the unit of depth cannot be known from the files: the median depth is {medians}; give "
            "--depth-scale, the stored value of one metre"
        )
    return DepthUnit(scales[0], f"depth was taken as {scales[0]:g} units a metre, because {why}")


def plausible_range(scale: float, values: np.ndarray) -> bool:
    """Whether the stored values are depths of a hand-held camera in this unit."""
    if not len(values):
        return True
    near, middle, far = (float(np.percentile(values, q)) / scale for q in (1, 50, 95))
    nearest_m = NEAREST_TUM_M if scale == 5000.0 else NEAREST_M
    return near >= nearest_m and middle <= FARTHEST_MEDIAN_M and far <= FARTHEST_M


def _has_fractions(values: np.ndarray) -> bool:
    return bool((np.mod(values[:10_000], 1) != 0).any())


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


def some_depths(files: abc.Sequence[Path], n: int = 8) -> list[np.ndarray]:
    """A few depth images as stored, spread over the recording; damaged ones are left out."""
    found = []
    for i in sorted({int(i) for i in np.linspace(0, len(files) - 1, n)}):
        try:
            found.append(read_depth_file(files[i], 1.0))
        except BadFrameError:
            continue
    return found
