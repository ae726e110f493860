"""How many stored units are a metre: what the depths say about it.

A 16-bit depth image does not say its unit. Recordings in the TUM layout have 5000 units a metre
(the benchmark's own), most cameras' software 1000, and some programs 10,000, 6553.5, 4000 or 2000,
which the range of the depths cannot tell apart. So the range only gives a guess, and the camera's
motion decides where poses are given (``depth_motion``).
"""

from collections import abc
from pathlib import Path

import numpy as np

from ...data.readers.tum import DEPTH_SCALE, benchmark_camera
from ...data.recorded.images import LOST_PRECISION
from ...errors import BadFrameError, SequenceError
from .depth_files import read_depth_file
from .recording import DepthUnit, OptionNeeded

USUAL = (1000.0, 5000.0)
KNOWN = (1000.0, 5000.0, 10_000.0, 6553.5, 4000.0, 2000.0, 512.0, 256.0, 100.0, 1.0)
"""Units that programs write, the usual ones first: 10,000 (BOP, other tenths of a millimetre),
6553.5 (Replica of NICE-SLAM), 4000 (Matterport3D), 512 (2D-3D-S), 256 (KITTI), centimetres and
metres."""
NEAREST_M = 0.2
FARTHEST_MEDIAN_M = 5.0
FARTHEST_M = 12.0
"""Depths of a hand-held camera: the first percentile is not nearer, the median and the 95th
percentile not farther."""
NEAREST_TUM_M = 0.35
"""5000 units a metre come from cameras of the Kinect's kind, which measure nothing nearer."""


WHOLE_METRES = 64
"""Whole numbers that are never larger are metres, or steps as coarse."""


def find_depth_unit(folder: Path, samples: abc.Sequence[np.ndarray]) -> DepthUnit:
    """Guess the stored value of one metre from the range of the depths.

    Args:
        folder: Of the recording; the benchmark's cameras are known by its name, and their unit is
            no guess.
        samples: Some depth images as stored, 0 = missing. [H, W] each

    Raises:
        SequenceError: no depth, or the depths are so coarse that no unit helps.
    """
    if benchmark_camera(folder):
        return DepthUnit(DEPTH_SCALE, "depth was taken in the benchmark's 5000 units a metre")
    values = np.concatenate([image[image > 0].ravel() for image in samples] or [np.zeros(0)])
    if not len(values):
        raise SequenceError(
            f"{folder}: the depth images tried hold no depth; give --depth-scale, units per metre"
        )
    metric = (1.0,) if (np.mod(values[:10_000], 1) != 0).any() else ()
    if not metric and values.max() <= WHOLE_METRES:
        raise SequenceError(
            f"{folder} holds depths in whole metres up to {values.max():g}, so {LOST_PRECISION}"
        )
    usual = [s for s in (*USUAL, *metric) if plausible_range(s, values)]
    middle = float(np.median(values))
    if len(usual) == 1:
        return DepthUnit(
            usual[0],
            f"depth was taken as {usual[0]:g} units a metre{_doubt(usual[0], values)}",
            True,
        )
    medians = ", ".join(f"{middle / s:.2f} m with {s:g}" for s in USUAL)
    question = OptionNeeded(
        f"{folder}: the unit of depth cannot be known from the files: the median depth is "
        f"{medians}; give --depth-scale, the stored value of one metre",
        option="depth_scale",
        question=f"Which stored depth is one metre? The median depth is {medians}.",
    )
    return DepthUnit(usual[0] if usual else USUAL[0], "", True, question)


def _doubt(scale: float, values: np.ndarray) -> str:
    """Why a unit was guessed, and what else it may be."""
    middle = float(np.median(values))
    plausible = [s for s in KNOWN if s != scale and plausible_range(s, values)]
    others = sorted(plausible, key=lambda s: abs(np.log(s / scale)))[:3]
    scales_text = ", ".join(f"{s:g} would be {middle / s:.2f} m" for s in others)
    return (
        f", because that gives depths of a hand-held camera, {middle / scale:.2f} m in the median"
        f"{f'; nothing proves it: {scales_text}' if scales_text else ''} (--depth-scale)"
    )


def plausible_range(scale: float, values: np.ndarray) -> bool:
    """Whether the stored values are depths of a hand-held camera in this unit."""
    if not len(values):
        return True
    near_m, middle, far_m = (float(np.percentile(values, q)) / scale for q in (1, 50, 95))
    nearest_m = NEAREST_TUM_M if scale == 5000.0 else NEAREST_M
    return near_m >= nearest_m and middle <= FARTHEST_MEDIAN_M and far_m <= FARTHEST_M


def some_depths(
    files: abc.Sequence[Path],
    n: int = 8,
) -> list[np.ndarray]:
    """A few depth images as stored, spread over the recording; damaged ones are left out.

    Raises:
        BadFrameError: none can be read; the reason of the first.
    """
    samples = []
    errors = []
    for i in sorted({int(i) for i in np.linspace(0, len(files) - 1, n)}):
        try:
            samples.append(read_depth_file(files[i], 1.0))
        except BadFrameError as e:
            errors.append(e)
    if not samples and errors:
        raise errors[0]
    return samples
