"""The path of a camera between the times of its poses."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...geometry import se3
from ..sequence import SequenceError

_LONGEST_GAP = 4.0
"""A neighbour farther away than this many median steps does not say how the camera moved."""


class PosePath:
    """Poses at any time, interpolated on SE(3).

    About its nearest pose T_k the path is T_k exp(xi(s)), where xi is the parabola in the time s since that pose which
    also goes through the poses before and after it; at the ends of the recording, and beside a gap, a straight line.

    Args:
        times_s: Increasing times. [L]
        poses: Camera-to-world, float64; NaN where there is none. [L, 4, 4]
    """

    def __init__(self, times_s: Float[Tensor, " L"], poses: Float[Tensor, "L 4 4"]):
        known = torch.isfinite(poses).all(dim=(1, 2)) & torch.isfinite(times_s)
        known[1:] &= times_s[1:] > times_s[:-1].cummax(0).values
        self._times, self._poses = times_s[known].double(), poses[known].double()
        steps = self._times.diff()
        self.step_s = float(steps.median()) if len(steps) else 0.0
        """Median time from one pose to the next, seconds; 0 with fewer than two poses."""
        twists = se3.log(se3.inverse(self._poses[:-1]) @ self._poses[1:])
        near = (steps <= _LONGEST_GAP * self.step_s)[:, None]
        nothing = twists.new_zeros(1, 6)
        # the velocity towards the neighbour on each side, where it is near
        after = torch.cat([twists / steps[:, None], nothing]), torch.cat([near, near.new_zeros(1, 1)])
        before = torch.cat([nothing, twists / steps[:, None]]), torch.cat([near.new_zeros(1, 1), near])
        dt_after, dt_before = (torch.cat(x)[:, None] for x in ([steps, steps.new_ones(1)], [steps.new_ones(1), steps]))
        both = after[1] & before[1]
        width = dt_after + dt_before
        through = (dt_before * after[0] + dt_after * before[0]) / width
        one_side = after[0].where(after[1], before[0].where(before[1], nothing))
        self._velocity = through.where(both, one_side)
        self._bend = ((after[0] - before[0]) / width).where(both, 0.0)

    def at(self, times_s: Float[Tensor, " N"]) -> Float[Tensor, "N 4 4"]:
        """Camera-to-world poses; NaN farther than one median step from every pose. [N, 4, 4]"""
        if not len(self._times):
            return times_s.new_full((len(times_s), 4, 4), torch.nan)
        right = torch.searchsorted(self._times, times_s).clamp(max=len(self._times) - 1)
        left = (right - 1).clamp_min(0)
        k = right.where((self._times[right] - times_s).abs() < (times_s - self._times[left]).abs(), left)
        s = (times_s - self._times[k])[:, None]
        T = self._poses[k] @ se3.exp(self._velocity[k] * s + self._bend[k] * s * s)
        return T.where((s.abs() <= self.step_s)[..., None], torch.nan)


def times_of(source: Any) -> Float[Tensor, " L"] | None:
    """The times of the frames of a sequence or of a part of one, seconds; None where it has none."""
    if hasattr(source, "positions"):
        times = times_of(source.source)
        return None if times is None else times[source.positions]
    try:
        times = getattr(source, "times_s", None)
    except SequenceError:
        return None
    if times is None:
        times = getattr(source, "timestamps_s", None)
    if times is None or getattr(source, "no_times", ""):
        return None
    return torch.as_tensor(times, dtype=torch.float64)
