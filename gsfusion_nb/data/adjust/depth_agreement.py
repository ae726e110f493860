"""How well the depth of one frame predicts that of another, and a quick test of a recording by it.

Points of one depth image are moved into another under one or many relative poses. ``check_sequence`` does so for a few
pairs of frames under the usual mistakes; ``gsfusion-nb check`` tests more.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ...config import RepairConfig
from ...geometry import depth_to_points, project, se3
from ...types import Camera, Frame
from ..sequence import BadFrameError, Sequence, SequenceError
from .poses import reread_poses

AGREES = 0.03
"""A point agrees when its depth differs by less than this share: a Kinect's noise at 4 m is 1 to 2 per cent."""

_MIN_ANGLE_RAD = 0.12

AS_READ = "as read"
USUAL_INTERPRETATIONS = {
    AS_READ: RepairConfig(),
    "inverted poses (they are world-to-camera)": RepairConfig(poses="world_to_camera"),
    "OpenGL axes (y up, z backward)": RepairConfig(axes="opengl"),
    "a depth scale that was 1000 instead of 5000": RepairConfig(depth_factor=0.2),
    "a depth scale that was 5000 instead of 1000": RepairConfig(depth_factor=5.0),
    "a depth scale that was 1000 instead of 6553.5": RepairConfig(depth_factor=0.1526),
}
"""The most frequent mistakes, and what repairs them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthPair:
    """Points of a frame ``a`` and the depth image of a frame ``b`` of the same world."""

    xyz_a: Float[Tensor, "N 3"]
    """Valid points of ``a``, in its camera's frame, metres."""
    depth_b: Float[Tensor, "H W"]
    """z-depth, metres, 0 = missing."""
    camera: Camera
    """Camera of ``depth_b``."""
    frames: tuple[int, int] = (0, 1)
    """Their positions in the sequence."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthConsistency:
    """How well two depth images agree under each of K relative poses."""

    agreeing: Float[Tensor, " K"]
    """Share of ``a``'s points that fall on a depth of ``b`` which differs by less than 3 per cent."""
    overlap: Float[Tensor, " K"]
    """Share of ``a``'s points that fall on a valid depth of ``b``."""
    median_m: Float[Tensor, " K"]
    """Median absolute difference of z-depth over those points, metres; NaN if there are none."""
    score: Float[Tensor, " K"]
    """Mean of max(0, 1 - difference / 3 per cent) over all points: 1 for exact agreement everywhere."""


def depth_pair(
    depth_a: Float[Tensor, "H W"],
    depth_b: Float[Tensor, "H W"],
    camera: Camera,
    *,
    step: int = 4,
    frames: tuple[int, int] = (0, 1),
) -> DepthPair:
    """The pair of every ``step``-th pixel of ``depth_a`` in both directions and all of ``depth_b``."""
    points = depth_to_points(camera, depth_a)[step // 2 :: step, step // 2 :: step].reshape(-1, 3)
    return DepthPair(xyz_a=points[points[:, 2] > 0], depth_b=depth_b, camera=camera, frames=frames)


def depth_consistency(pair: DepthPair, T_ba: Float[Tensor, "K 4 4"]) -> DepthConsistency:
    """Move the points of ``a`` into ``b`` under each pose and compare with the depth of the pixel they fall on.

    Args:
        pair: Points and depth.
        T_ba: Transforms from camera ``a`` to camera ``b``. [K, 4, 4]
    """
    T = T_ba.to(pair.xyz_a.dtype)
    P = pair.xyz_a @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3]
    z = P[..., 2]
    front = z > 1e-6
    uv = project(pair.camera, torch.where(front[..., None], P, torch.ones_like(P)))
    u, v = uv[..., 0].floor(), uv[..., 1].floor()
    inside = front & (u >= 0) & (u < pair.camera.width) & (v >= 0) & (v < pair.camera.height)
    measured = pair.depth_b[v.where(inside, 0.0).long(), u.where(inside, 0.0).long()]
    seen = inside & (measured > 0)
    error = (z - measured).abs()
    unit = (error / (AGREES * measured.clamp_min(1e-9))).where(seen, torch.inf)
    total = max(pair.xyz_a.shape[0], 1)
    return DepthConsistency(
        agreeing=(unit < 1).sum(-1) / total,
        overlap=seen.sum(-1) / total,
        median_m=error.where(seen, torch.nan).nanmedian(dim=-1).values
        if len(pair.xyz_a)
        else torch.full((len(T),), torch.nan),
        score=(1 - unit).clamp_min(0).sum(-1) / total,
    )


def thinned(camera: Camera, depth_m: Float[Tensor, "H W"], step: int) -> tuple[Camera, Float[Tensor, "h w"]]:
    """Every ``step``-th pixel of a depth image as a smaller image with the same rays; nothing is interpolated."""
    first = (step - 1) // 2
    small = depth_m[first::step, first::step]
    moved = {"cx": (camera.cx - first - 0.5) / step + 0.5, "cy": (camera.cy - first - 0.5) / step + 0.5}
    size = {"width": small.shape[1], "height": small.shape[0]}
    return replace(camera, fx=camera.fx / step, fy=camera.fy / step, **moved, **size), small


def relative_poses(T_WA: Float[Tensor, "K 4 4"], T_WB: Float[Tensor, "K 4 4"]) -> Float[Tensor, "K 4 4"]:
    """Transforms from camera A to camera B. [K, 4, 4]"""
    return se3.inverse(T_WB) @ T_WA


@dataclass(frozen=True, kw_only=True)
class DepthAgreement:
    """How well the depth of one frame predicts that of another."""

    median_m: float
    """Median absolute difference of z-depth over the pixels that both see, metres; NaN if there are none."""
    overlap: float
    """Share of the first frame's points that fall on a valid depth of the second."""
    agreeing: float
    """Share of the first frame's points that also agree with it within 3 per cent."""


@dataclass(frozen=True, kw_only=True)
class SequenceCheck:
    """The interpretation of poses and depth scale under which neighbouring frames agree best."""

    agreeing: dict[str, float]
    """Share of agreeing points for each interpretation; "as read" is the sequence as it is."""

    @property
    def best(self) -> str:
        """The interpretation under which most points agree."""
        return max(self.agreeing, key=self.agreeing.__getitem__)

    @property
    def ok(self) -> bool:
        """Whether a third of the points agree as read, and no other interpretation is clearly better."""
        as_read = self.agreeing[AS_READ]
        return as_read > 1 / 3 and self.agreeing[self.best] < as_read + 0.1

    def __str__(self) -> str:
        share = f"{self.agreeing[AS_READ]:.0%} of the points of a frame agree with a later frame"
        if self.ok:
            return f"consistent: {share}"
        if self.best == AS_READ:
            return f"doubtful: only {share}, and no usual mistake explains it; gsfusion-nb check tries more"
        return (
            f"inconsistent: only {share}, but {self.agreeing[self.best]:.0%} do with {self.best}: "
            f"{USUAL_INTERPRETATIONS[self.best].flags}; gsfusion-nb check finds more"
        )


def depth_agreement(a: Frame, b: Frame, *, step: int = 4) -> DepthAgreement:
    """Move the points of frame ``a`` into frame ``b`` and compare with the depth measured there.

    Args:
        a, b: Two frames with the same world frame and camera.
        step: Every step-th pixel of ``a`` in both directions is used.
    """
    T_ba = relative_poses(a.T_WC.double()[None], b.T_WC.double()[None])
    found = depth_consistency(depth_pair(a.depth_m, b.depth_m, b.camera, step=step), T_ba)
    return DepthAgreement(median_m=float(found.median_m), overlap=float(found.overlap), agreeing=float(found.agreeing))


def check_sequence(sequence: Sequence, *, pairs: int = 4) -> SequenceCheck:
    """Try the usual mistakes on a few pairs of frames: inverted poses, OpenGL axes, a wrong depth scale.

    Args:
        sequence: Any sequence with some motion.
        pairs: Number of pairs, spread over the sequence.

    Raises:
        SequenceError: no two usable frames.
    """
    scores = []
    for k in range(pairs):
        first = k * len(sequence) // (pairs + 1)
        try:
            a, b = sequence[first], sequence[_partner(sequence, first)]
        except BadFrameError:
            continue
        if a.index == b.index:
            continue
        stored = torch.stack([a.T_WC, b.T_WC]).double()
        T_ba = torch.cat([relative_under(stored[:1], stored[1:], r) for r in USUAL_INTERPRETATIONS.values()])
        scores.append(depth_consistency(depth_pair(a.depth_m, b.depth_m, b.camera), T_ba).agreeing)
    if not scores:
        raise SequenceError(f"{sequence.name} has no two usable frames; expected at least two to compare")
    mean = torch.stack(scores).mean(0).tolist()
    return SequenceCheck(agreeing=dict(zip(USUAL_INTERPRETATIONS, mean, strict=True)))


def relative_under(T_a: torch.Tensor, T_b: torch.Tensor, interpretation: RepairConfig) -> torch.Tensor:
    """Transforms from camera a to camera b, in units of the depth as read, if ``interpretation`` is right. [P, 4, 4]

    A factor on depth scales all points and keeps directions, so the translation is divided by it instead.

    Args:
        T_a, T_b: Poses as stored. [P, 4, 4]
        interpretation: How poses and depth are interpreted.
    """
    n = len(T_a)
    T = reread_poses(torch.cat([T_a, T_b]), interpretation)
    relative = relative_poses(T[:n], T[n:])
    relative[:, :3, 3] /= interpretation.depth_factor
    return relative


def _partner(sequence: Sequence, first: int) -> int:
    """The next frame, at most 30 later, that is rotated or moved enough to reveal a wrong interpretation."""
    T = sequence.pose(first).double()
    last = min(first + 30, len(sequence) - 1)
    for i in range(first + 1, last):
        relative = se3.inverse(T) @ sequence.pose(i).double()
        moved_m = float(relative[:3, 3].norm())
        if float(se3.rotation_angle(relative[:3, :3])) > _MIN_ANGLE_RAD or moved_m > 0.15:
            return i
    return last
