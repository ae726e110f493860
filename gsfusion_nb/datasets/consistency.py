"""Do depth, poses and intrinsics of a sequence fit together? Points of one frame, seen from another, tell."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import depth_to_points, project, se3
from ..types import Frame
from .protocol import BadFrameError, Sequence, SequenceError

AGREES = 0.03
"""A point agrees when its depth differs by less than this share: a Kinect's noise at 4 m is 1 to 2 per cent."""

_MIN_ANGLE_RAD = 0.12
_GL_TO_CV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
_DEPTH_FACTORS = {"1000 instead of 5000": 0.2, "5000 instead of 1000": 5.0, "1000 instead of 6553.5": 0.1526}


@dataclass(frozen=True, kw_only=True)
class DepthAgreement:
    """How well the depth of one frame predicts that of another."""

    median_m: float
    """Median absolute difference of z-depth over the pixels both see, metres; NaN where they share none."""
    overlap: float
    """Share of the first frame's points that fall on a valid depth of the second."""
    agreeing: float
    """Share of the first frame's points that also agree with it within 3 per cent."""


@dataclass(frozen=True, kw_only=True)
class SequenceCheck:
    """Which reading of poses and depth scale makes neighbouring frames agree best."""

    agreeing: dict[str, float]
    """Share of agreeing points for each reading; "as read" is the sequence as it is."""

    @property
    def best(self) -> str:
        """The reading under which most points agree."""
        return max(self.agreeing, key=self.agreeing.__getitem__)

    @property
    def ok(self) -> bool:
        """Whether a third of the points agree as read, and no other reading is clearly better."""
        as_read = self.agreeing["as read"]
        return as_read > 1 / 3 and self.agreeing[self.best] < as_read + 0.1

    def __str__(self) -> str:
        share = f"{self.agreeing['as read']:.0%} of the points of a frame agree with a later frame"
        if self.ok:
            return f"consistent: {share}"
        if self.best == "as read":
            return (
                f"doubtful: only {share}, and no other reading of poses or depth scale is better; check the intrinsics"
            )
        return f"inconsistent: only {share}, but {self.agreeing[self.best]:.0%} do with {self.best}"


def depth_agreement(a: Frame, b: Frame, *, step: int = 4) -> DepthAgreement:
    """Move the points of frame ``a`` into frame ``b`` and compare with the depth measured there.

    Args:
        a, b: Two frames of one world.
        step: Every step-th pixel of ``a`` in both directions is used.
    """
    return _agreement(a, b, se3.inverse(b.T_WC.double()) @ a.T_WC.double(), 1.0, step)


def check_sequence(sequence: Sequence, *, pairs: int = 4) -> SequenceCheck:
    """Try the usual mistakes on a few pairs of frames: inverted poses, OpenGL axes, a wrong depth scale.

    Args:
        sequence: Any sequence with some motion.
        pairs: Number of pairs, spread over the sequence.

    Raises:
        SequenceError: no two usable frames.
    """
    scores: dict[str, list[float]] = {}
    for k in range(pairs):
        first = k * len(sequence) // (pairs + 1)
        try:
            a, b = sequence[first], sequence[_partner(sequence, first)]
        except BadFrameError:
            continue
        if a.index == b.index:
            continue
        for name, (T_ba, factor) in _readings(a.T_WC.double(), b.T_WC.double()).items():
            scores.setdefault(name, []).append(_agreement(a, b, T_ba, factor, 4).agreeing)
    if not scores:
        raise SequenceError(f"{sequence.name} has no two usable frames; expected some to compare")
    return SequenceCheck(agreeing={name: sum(s) / len(s) for name, s in scores.items()})


def _partner(sequence: Sequence, first: int) -> int:
    """The next frame that has turned or moved enough for a wrong reading to show, at most 30 later."""
    T = sequence.pose(first).double()
    last = min(first + 30, len(sequence) - 1)
    for i in range(first + 1, last):
        relative = se3.inverse(T) @ sequence.pose(i).double()
        moved_m = float(relative[:3, 3].norm())
        if float(se3.rotation_angle(relative[:3, :3])) > _MIN_ANGLE_RAD or moved_m > 0.15:
            return i
    return last


def _readings(T_a: Float[Tensor, "4 4"], T_b: Float[Tensor, "4 4"]) -> dict[str, tuple[Float[Tensor, "4 4"], float]]:
    """Relative pose a -> b and factor on depth under each reading."""
    gl = _GL_TO_CV.double()
    as_read = se3.inverse(T_b) @ T_a
    readings = {
        "as read": (as_read, 1.0),
        "inverted poses (they are world-to-camera)": (T_b @ se3.inverse(T_a), 1.0),
        "OpenGL axes (y up, z backward)": (gl @ as_read @ gl, 1.0),
    }
    for name, factor in _DEPTH_FACTORS.items():
        readings[f"a depth scale that was {name}"] = (as_read, factor)
    return readings


def _agreement(a: Frame, b: Frame, T_ba: Float[Tensor, "4 4"], factor: float, step: int) -> DepthAgreement:
    points = depth_to_points(a.camera, a.depth_m)[::step, ::step].reshape(-1, 3)
    points = points[points[:, 2] > 0]
    total = max(len(points), 1)
    P = se3.apply(T_ba.to(points.dtype), points * factor)
    P = P[P[:, 2] > 0]
    uv = project(b.camera, P).floor()
    inside = (uv[:, 0] >= 0) & (uv[:, 0] < b.camera.width) & (uv[:, 1] >= 0) & (uv[:, 1] < b.camera.height)
    uv, z = uv[inside].long(), P[inside, 2]
    measured = b.depth_m[uv[:, 1], uv[:, 0]] * factor
    z, measured = z[measured > 0], measured[measured > 0]
    error = (z - measured).abs()
    return DepthAgreement(
        median_m=float(error.median()) if len(error) else float("nan"),
        overlap=len(z) / total,
        agreeing=float((error < AGREES * measured).sum()) / total,
    )
