"""The mapped frames of a run that can be read again: to be scored, drawn and looked at."""

import dataclasses
import math
from typing import Any, Protocol, runtime_checkable

from ..data import FrameSubset
from ..geometry import se3

COVERING_M = 1.0
COVERING_DEG = 30.0
"""Views between which the camera has moved or turned by less overlap on any walk."""


@runtime_checkable
class MappedViews(Protocol):
    """Views that a run has mapped."""

    def sample(self, limit: int) -> FrameSubset:
        """At most ``limit`` of the views, evenly spread; 0 means all."""
        ...

    def covering(self, least: int) -> FrameSubset:
        """Views that show all that the camera saw: ``least`` of them, and more if they do not
        overlap; all, if there are fewer."""
        ...


class RecordedViews:
    """Those of a recording: every frame can be read again.

    Args:
        run: The ``MappingRun``.
    """

    def __init__(self, run: Any):
        self._run = run

    def sample(self, limit: int) -> FrameSubset:
        """At most ``limit`` of the frames mapped so far, evenly spread; 0 means all."""
        mapping = self._run.sequence.mapping
        n = self._run.next_position
        return dataclasses.replace(
            mapping, positions=[mapping.positions[i] for i in evenly(n, limit)]
        )

    def covering(self, least: int) -> FrameSubset:
        """At least this many mapped frames, evenly spread, and those where the camera has moved by
        1 m or turned by 30 degrees since the last one, so that neighbours overlap on any walk."""
        run = self._run
        frame_indices = run.mapper.trajectory.frame_indices[run.n_earlier :]
        poses = run.poses
        selection = list[int]()
        stride = max(1, len(poses) // least)
        for i, T_WC in enumerate(poses):
            turned_deg, moved_m = (
                se3.motion(poses[selection[-1]], T_WC) if i % stride else (math.inf, math.inf)
            )
            if turned_deg >= COVERING_DEG or moved_m >= COVERING_M:
                selection.append(i)
        return dataclasses.replace(
            run.sequence.mapping, positions=[frame_indices[i] for i in selection]
        )


def evenly(n: int, limit: int) -> list[int]:
    """At most ``limit`` of the numbers 0..n-1, evenly spread from the first to the last; 0 means
    all."""
    if not limit or n <= limit:
        return list(range(n))
    return [round(i * (n - 1) / max(limit - 1, 1)) for i in range(limit)]
