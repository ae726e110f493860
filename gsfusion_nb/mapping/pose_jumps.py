"""Given poses that no camera reaches from those before: exports with a frame of another place."""

from typing import Any

from ..errors import BadFrameError
from ..geometry import se3
from ..types import Frame

FASTEST_M_S = 20.0
FASTEST_DEG_S = 1500.0
"""No camera in a hand, on a robot or on a slow car moves or turns faster."""
FARTHEST_STEP_M = 2.0
FARTHEST_STEP_DEG = 120.0
"""Up to this for each frame between them two poses are no jump at any speed: time stamps may be
missing or wrong."""


class PoseJumps:
    """Finds jumps between the given poses of frames.

    Args:
        action: What is done with a frame after a jump: "skip" or "map".
    """

    def __init__(self, action: str):
        self._action = action
        self._last_mapped: dict[str, Any] | None = None
        self._last_refused: dict[str, Any] | None = None
        """Index, time and given pose of the frame mapped last, and of one refused since: the next
        may go on there."""

    def check(self, frame: Frame) -> str:
        """How far the frame is from those before, if no camera moves so fast; else empty.

        Raises:
            BadFrameError: it is a jump, both from the last mapped frame and from a frame just
                refused, and such frames are skipped.
        """
        jump = "" if self._last_mapped is None else jump_from(self._last_mapped, frame)
        goes_on = self._last_refused is not None and not jump_from(self._last_refused, frame)
        if jump and self._action == "skip" and not goes_on:
            self._last_refused = _stand_of(frame)
            raise BadFrameError(
                f"frame {frame.index} cannot be mapped: {jump}. Frames that go on from there are "
                "mapped. If the pose is right: --tracking.pose-jumps map"
            )
        return jump

    def record(self, frame: Frame) -> None:
        """The frame was mapped."""
        self._last_mapped = _stand_of(frame)
        self._last_refused = None

    def state_dict(self) -> list[dict[str, Any] | None]:
        """What the next frame is compared with."""
        return [self._last_mapped, self._last_refused]

    def load_state_dict(self, state: list[dict[str, Any] | None]) -> None:
        """Restore what ``state_dict`` saved."""
        self._last_mapped, self._last_refused = state


def _stand_of(frame: Frame) -> dict[str, Any]:
    """Where a frame was taken, and when."""
    return {"index": frame.index, "timestamp_s": frame.timestamp_s, "T_WC": frame.T_WC_cpu.clone()}


def jump_from(stand: dict[str, Any], frame: Frame) -> str:
    """How far the pose of a frame is from ``stand`` of an earlier one, in words, if no camera moves
    so fast."""
    angle_deg, distance_m = (float(x) for x in se3.motion(stand["T_WC"], frame.T_WC_cpu))
    seconds = max(frame.timestamp_s - stand["timestamp_s"], 0.0)
    frames = max(abs(frame.index - stand["index"]), 1)
    most_m = max(FARTHEST_STEP_M * frames, FASTEST_M_S * seconds)
    most_deg = max(FARTHEST_STEP_DEG * frames, FASTEST_DEG_S * seconds)
    if distance_m <= most_m and angle_deg <= most_deg:
        return ""
    return (
        f"its pose is {distance_m:.3g} m and {angle_deg:.0f} degrees from that of frame "
        f"{stand['index']}, {seconds:.3g} s before; a camera moves at most {most_m:.3g} m and "
        f"{min(most_deg, 180):.0f} degrees"
    )
