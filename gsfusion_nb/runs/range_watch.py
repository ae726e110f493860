"""A watch beside a run: is the depth of the recording in the range that is mapped?"""

import torch
from jaxtyping import Float
from torch import Tensor

from ..data.adjust.depth_range import DepthRange
from ..render.near_plane import near_plane_m
from ..types import Frame
from .quiet_watch import WatchedRun

LOOKED_AT = 12
"""Frames that are looked at: the first dozen."""
_VALUES = 10_000
"""Of each of them, at most about so many depths."""


class RangeWatch:
    """Collects depth of the first frames of a run, and warns once if much of it is not mapped, or
    mapped but not drawn."""

    def __init__(self) -> None:
        self._depths_m: list[Tensor] = []
        self._is_over = False

    def look(self, run: WatchedRun, frame: Frame | None) -> None:
        """Look at the frame that was mapped last; None: no more will come."""
        n_before = len(run.steps) - len(self._depths_m)
        if self._is_over or n_before > LOOKED_AT:  # it goes on, after its first frames
            return
        depth_range = DepthRange.of(run.mapper.config)
        if frame is not None:
            measured_m = _measured_m(run, frame, depth_range)
            self._depths_m.append(measured_m[:: max(1, len(measured_m) // _VALUES)].cpu())
            if len(self._depths_m) < LOOKED_AT:
                return
        self._is_over = True
        if not self._depths_m:
            return
        depths_m = torch.cat(self._depths_m)
        self._depths_m = []
        outside = depth_range.outside(depths_m)
        if outside.is_much:
            run.warnings.warn_once(f"{outside.sentence}; to map it: {outside.flags}")
        plane_m = near_plane_m(run.mapper.config)
        hidden = DepthRange(near_m=plane_m, far_m=torch.inf, settings=depth_range.settings)
        not_drawn = hidden.outside(depths_m[depths_m >= depth_range.near_m])
        if not_drawn.is_much:
            run.warnings.warn_once(
                f"{not_drawn.nearer:.0%} of the measured depth is nearer than {plane_m:g} m, where "
                f"no Gaussians are drawn while {depth_range.settings[0]} is "
                f"{depth_range.near_m:g}; to draw them: {not_drawn.flags}"
            )


def _measured_m(run: WatchedRun, frame: Frame, depth_range: DepthRange) -> Float[Tensor, " N"]:
    """The depth of a frame as it was measured, metres. Where the settings limit what is read, a
    recording is read again; of a stream only what is within the limits is known."""
    if depth_range.limits_reading and run.resumable:
        frame = run.sequence.mapping.source[frame.index]
    return frame.depth_m[frame.depth_m > 0]
