"""What tracking says of a frame: its pose and how it was found, or why there is none."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from ..errors import ForeseenError
from ..types import Frame
from .icp import ExtraRows, IcpResult


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackingReport:
    """The pose of one frame and how it was found."""

    status: Literal["first", "ok", "degenerate", "recovered", "located"]
    """"first": pose from the data; "degenerate": some directions of motion, which the scene does
    not determine, are predicted; "recovered": ICP failed from the predicted pose, also with
    smoothed normals, but not from another start; "located": by appearance, in a map where the
    camera was not seen before."""
    T_WC: Float[Tensor, "4 4"]
    """Camera-to-world pose, float32."""
    start: str = ""
    """Where the successful ICP started: "the predicted pose", "the last pose", ..."""
    doubt: str = ""
    """Why other starts were tried although the first led to a pose within the limits."""
    icp: IcpResult | None = None
    """How well the pose fits, and every step of the successful ICP; None for the first frame."""


class TrackingLostError(ForeseenError, ValueError):
    """No pose of this frame fits the model; the message lists what was tried and why it failed."""


PoseFinder = Callable[[Frame, Tensor], Tensor]
"""``find(frame, T_predicted)``: the camera-to-world pose of a frame, found from the predicted one;
both [4, 4]. It raises ``TrackingLostError`` where it finds none."""
Relocaliser = Callable[[Frame], Sequence[tuple[Tensor, ExtraRows | None]]]
"""Returns possible poses ``T_WC`` [4, 4] of a frame by its appearance, the most likely first, and
the further rows for ICP of the landmarks that agree with it, if there are any."""
