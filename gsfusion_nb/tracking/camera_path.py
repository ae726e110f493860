"""Where the camera was in the last two frames, and where it will be next if it goes on so."""

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

from jaxtyping import Float
from torch import Tensor

from ..backends import piece
from ..errors import ArgumentError
from ..geometry import se3

MAX_TIME_RATIO = 4.0
"""The last motion is extrapolated for at most this many times its duration."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackedPose:
    """A tracked pose and its time."""

    T_WC: Float[Tensor, "4 4"]
    """Camera-to-world, float64."""
    timestamp_s: float


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraPath:
    """The end of the path of a tracked camera."""

    last: TrackedPose | None = None
    """None before the first frame."""
    last_but_one: TrackedPose | None = None
    """The frame before the last one, if both were tracked; the motion between them is the
    velocity."""

    def then(self, pose: TrackedPose, *, moved: bool) -> "CameraPath":
        """The path with one more pose. ``moved``: the camera moved there from the last one, so that
        there is a velocity."""
        return CameraPath(last=pose, last_but_one=self.last if moved else None)

    def corrected(self, T_change: Float[Tensor, "4 4"]) -> "CameraPath":
        """The path in which every pose T is ``T_change @ T``.

        The products are made rigid: a correction is T_new T_old^-1, so what is not rigid in the
        last pose is in the next correction, too, and would more than double each time.

        Args:
            T_change: Float64.
        """
        last, last_but_one = (
            pose and dataclasses.replace(pose, T_WC=se3.rigid(T_change @ pose.T_WC))
            for pose in (self.last, self.last_but_one)
        )
        return CameraPath(last=last, last_but_one=last_but_one)

    def predict(
        self, timestamp_s: float, *, prior: Literal["constant_velocity", "previous"]
    ) -> Float[Tensor, "4 4"]:
        """Predicted pose at a time: the last motion extrapolated in proportion to time, or the last
        pose. float64

        Frames are not evenly spaced in time (some are held out or dropped), so the motion is scaled
        by time.

        Raises:
            ValueError: before the first frame.
        """
        if self.last is None:
            raise ArgumentError("no pose can be predicted before the first frame has been tracked")
        if prior == "previous" or self.last_but_one is None:
            return self.last.T_WC
        step_s = self.last.timestamp_s - self.last_but_one.timestamp_s
        ahead_s = timestamp_s - self.last.timestamp_s
        ratio = min(ahead_s / step_s, MAX_TIME_RATIO) if step_s > 0 and ahead_s > 0 else 1.0
        return constant_velocity(self.last_but_one.T_WC, self.last.T_WC, ratio)

    def state_dict(self) -> dict[str, Any]:
        """The poses, as tensors and plain values."""
        return {
            "last": self.last and dataclasses.asdict(self.last),
            "before": self.last_but_one and dataclasses.asdict(self.last_but_one),
        }

    @classmethod
    def from_state_dict(cls, state: dict[str, Any]) -> "CameraPath":
        """The path that was saved with ``state_dict``."""
        last, last_but_one = (
            saved and TrackedPose(**saved) for saved in (state["last"], state["before"])
        )
        return cls(last=last, last_but_one=last_but_one)


@piece
def constant_velocity(
    T_before: Float[Tensor, "4 4"], T_last: Float[Tensor, "4 4"], ratio: float = 1.0
) -> Float[Tensor, "4 4"]:
    """The pose after the last motion has gone on, in the camera's own axes.

    Args:
        T_before, T_last: Camera-to-world poses of the last two frames.
        ratio: Time ahead as a share of the time between these frames.

    Differentiable: yes.
    """
    return T_last @ se3.exp(ratio * se3.log(se3.inverse(T_before) @ T_last))
