"""Frames of a recording and where they are in a map: errors, and the numbers of all of them."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..evaluation import NotComputed
from ..geometry import se3
from ..tracking import Location

WITHIN_M = 0.03
"""Errors below this are counted as good, metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LocatedFrame:
    """A frame of the recording and where it is in the map."""

    index: int
    """Number of the frame in the recording."""
    timestamp_s: float
    location: Location
    T_WC_true: Float[Tensor, "4 4"] | None = None
    """Its pose by the recording, if that is in the frame of the map."""
    seconds: float = 0.0
    """Time to locate it, without reading it."""

    @property
    def error(self) -> tuple[float, float] | None:
        """Distance from the true pose, metres, and angle, degrees; None where one of the two poses
        is not known."""
        if self.location.T_WC is None or self.T_WC_true is None:
            return None
        angle_deg, distance_m = se3.motion(self.T_WC_true.double(), self.location.T_WC.double())
        return float(distance_m), float(angle_deg)

    def as_json(self) -> dict[str, Any]:
        """Plain values, for metrics.json."""
        location = self.location
        T_WC = location.T_WC
        distance_m, angle_deg = self.error or (None, None)
        return {
            "frame_index": self.index,
            "timestamp_s": self.timestamp_s,
            "is_located": location.is_located,
            "T_WC": None if T_WC is None else T_WC.flatten().tolist(),
            "way": location.way,
            "n_landmarks": location.n_landmarks,
            "rms_m": location.rms_m,
            "inlier_share": location.inlier_share,
            "reason": location.reason,
            "error_m": distance_m,
            "error_deg": angle_deg,
            "seconds": self.seconds,
        }


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class LocatedRecording:
    """The frames of a recording in the map of a run, the numbers, and the folder of the files."""

    frames: list[LocatedFrame]
    metrics: dict[str, Any]
    folder: Path
    warnings: list[str] = field(default_factory=list)

    @property
    def poses(self) -> dict[int, Float[Tensor, "4 4"]]:
        """Frame index -> camera-to-world pose in the map, of the located frames."""
        return {
            row.index: row.location.T_WC for row in self.frames if row.location.T_WC is not None
        }

    def __repr__(self) -> str:
        n = len(self.poses)
        return f"LocatedRecording({n} of {len(self.frames)} frames, files in {self.folder})"


def location_metrics(rows: Sequence[LocatedFrame], *, has_truth: bool) -> dict[str, Any]:
    """Share of located frames, errors and times, under the names of metrics.json."""
    n = len(rows)
    located_rows = [row for row in rows if row.location.is_located]
    metrics: dict[str, Any] = {
        "n_frames_to_locate": n,
        "n_located": len(located_rows),
        "share_located": len(located_rows) / n if n else NotComputed("there is no frame"),
        "seconds_per_located_frame": statistics.median(row.seconds for row in rows)
        if n
        else NotComputed("there is no frame"),
    }
    errors = [row.error for row in located_rows if row.error is not None]
    if errors:
        distances_m, angles_deg = zip(*errors, strict=True)
        good = sum(distance_m <= WITHIN_M for distance_m in distances_m)
        return metrics | {
            "share_within_3_cm": good / n,
            "location_error_median_m": statistics.median(distances_m),
            "location_error_mean_m": statistics.fmean(distances_m),
            "location_error_max_m": max(distances_m),
            "location_error_median_deg": statistics.median(angles_deg),
            "location_error_max_deg": max(angles_deg),
        }
    reason = "no frame was located" if has_truth else "no poses in the frame of the map are known"
    missing = NotComputed(reason)
    names = ("share_within_3_cm", "location_error_median_m", "location_error_median_deg")
    return metrics | dict.fromkeys(names, missing)
