"""How well a few frames of a recording agree with each other, as they are read and as they might be
read otherwise."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ...config import RepairConfig
from ...geometry import pixel_grid
from ...types import Camera, Frame
from .depth_agreement import AGREES, relative_poses, thinned
from .poses import axis_matrix, reread_poses
from .reprojection import (
    FEWEST_GREYS,
    Reprojection,
    gain_stops,
    greys_at,
    is_usable_grey,
    reproject_depth,
)
from .small_images import small_grey, without_speckle

WIDTH = 160
"""Frames are compared in copies of about this width, pixels."""
GAPS = (1, 3, 7)
"""Distances between the two of a pair, in the frames compared."""
POINTS = 300
"""Points of each frame."""
MOVED_PX = 2.0
"""Where points moved by less, pixels of a copy, pictures do not show whether they moved."""
_LEAST_CONTRAST = 4.0
"""Grey levels by which two pictures differ on average where nothing is moved: with less there is
nothing to see."""
_MOST_DIFFERENCE = 40.0
"""Larger differences of grey levels count as this: something hides the point."""
_LEAST_COLOUR_PAIRS = 3
NEAR_MIDDLE = 0.05
"""A principal point within this share of the image's width and height of its middle is usual: of a
Kinect 0.04."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SmallFrame:
    """Small copies of a frame's images, on the CPU."""

    index: int
    camera: Camera
    """Of the small depth image."""
    depth_m: Float[Tensor, "h w"]
    grey: UInt8[np.ndarray, "h w"]

    @staticmethod
    def of(frame: Frame) -> "SmallFrame":
        """Copies of ``frame``, which do not hold its images in memory."""
        camera, depth_m = thinned(
            frame.camera, frame.depth_m, max(1, round(frame.camera.width / WIDTH))
        )
        small_depth_m = torch.from_numpy(without_speckle(depth_m.cpu().numpy()))
        return SmallFrame(
            index=frame.index, camera=camera, depth_m=small_depth_m, grey=small_grey(frame, WIDTH)
        )


class Pairs(NamedTuple):
    """P pairs of frames with the same camera, reduced to N points each."""

    camera: Camera
    uv_a: Float[Tensor, "P N 2"]
    depth_a: Float[Tensor, "P N"]
    """Metres, 0 = missing."""
    depth_b: Float[Tensor, "P h w"]
    T_WA: Float[Tensor, "P 4 4"]
    T_WB: Float[Tensor, "P 4 4"]
    """Camera-to-world poses, float64."""

    def moved(
        self, T_ba: Float[Tensor, "P 4 4"] | None = None, camera: Camera | None = None
    ) -> Reprojection:
        """The points of the first frames in the second ones, as read or by another motion or
        camera."""
        T_ba = relative_poses(self.T_WA, self.T_WB) if T_ba is None else T_ba
        return reproject_depth(
            camera or self.camera, self.uv_a, self.depth_a, self.depth_b, T_ba.float()
        )


def pairs_of(
    frames: Sequence[SmallFrame],
    poses: Sequence[Float[Tensor, "4 4"]],
    places: Sequence[tuple[int, int]],
) -> Pairs:
    """The pairs of ``frames`` at ``places``, with their camera-to-world poses."""
    camera = frames[0].camera
    step = max(1, round(math.sqrt(camera.width * camera.height / POINTS)))
    uv = pixel_grid(camera)[step // 2 :: step, step // 2 :: step].reshape(-1, 2)
    u, v = uv.long().unbind(-1)
    first, second = ([pair[k] for pair in places] for k in (0, 1))
    T = torch.stack([pose.detach().cpu().double() for pose in poses])
    return Pairs(
        camera=camera,
        uv_a=uv.expand(len(places), -1, 2),
        depth_a=torch.stack([frames[a].depth_m[v, u] for a in first]),
        depth_b=torch.stack([frames[b].depth_m for b in second]),
        T_WA=T[first],
        T_WB=T[second],
    )


Reading = Callable[[Pairs], Reprojection]
"""How the pairs would agree if the recording meant something else."""


def _poses_as(repair: RepairConfig) -> Reading:
    def moved(pairs: Pairs) -> Reprojection:
        if repair.axes != "opencv":
            M = axis_matrix(repair)
            return pairs.moved(M @ relative_poses(pairs.T_WA, pairs.T_WB) @ M.T)
        a, b = (reread_poses(T, repair) for T in (pairs.T_WA, pairs.T_WB))
        return pairs.moved(relative_poses(a, b))

    return moved


def stands_still(pairs: Pairs) -> Reprojection:
    """As if the camera had not moved: points keep their pixel and their depth."""
    return pairs.moved(torch.eye(4, dtype=torch.float64).expand(len(pairs.T_WA), 4, 4))


def _depth_times(factor: float) -> Reading:
    def moved(pairs: Pairs) -> Reprojection:
        T_ba = relative_poses(pairs.T_WA, pairs.T_WB)
        T_ba[:, :3, 3] /= factor
        return pairs.moved(T_ba)

    return moved


def _focal_times(factor: float, *, with_centre: bool = False) -> Reading:
    def moved(pairs: Pairs) -> Reprojection:
        c = pairs.camera
        of_centre = factor if with_centre else 1.0
        other_camera = replace(
            c,
            fx=c.fx * factor,
            fy=c.fy * factor,
            cx=c.cx * of_centre,
            cy=c.cy * of_centre,
        )
        return pairs.moved(camera=other_camera)

    return moved


def _centred(pairs: Pairs) -> Reprojection:
    """With the principal point in the middle; as read if it is near: nothing is measured then."""
    c = pairs.camera
    middle = replace(c, cx=c.width / 2, cy=c.height / 2)
    is_near = (
        abs(c.cx - middle.cx) < NEAR_MIDDLE * c.width
        and abs(c.cy - middle.cy) < NEAR_MIDDLE * c.height
    )
    return pairs.moved(camera=c if is_near else middle)


READINGS: dict[str, Reading] = {
    "inverted poses": _poses_as(RepairConfig(poses="world_to_camera")),
    "inverted rotations": _poses_as(RepairConfig(poses="rotation_inverted")),
    **{
        f"the camera axes of {name}": _poses_as(RepairConfig(axes=name))
        for name in ("opengl", "ros", "unity")
    },
    "a camera that stands still": stands_still,
    "the principal point in the middle of the image": _centred,
    **{
        f"focal lengths {k:.3g} times as long": _focal_times(k)
        for k in (1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2)
    },
    **{f"intrinsics {k:.3g} times as large": _focal_times(k, with_centre=True) for k in (1 / 2, 2)},
    **{
        f"depth {k:g} times as large": _depth_times(k)
        for k in (0.001, 0.1, 0.2, 0.25, 4.0, 5.0, 10.0, 1000.0)
    },
}
"""What a recording may mean other than it was read, in words -> how it would agree."""


class FirstAgreement(NamedTuple):
    """How well frames agree. An agreement is the mean of max(0, 1 - difference / tolerance) over
    all points with depth, where the tolerance is three times the median of their relative
    differences in depth, 0.2 to 6 per cent."""

    share: float
    """Share of the points that differ by less than 3 per cent in depth."""
    overlap: float
    """Share of the points that fall on a measured depth."""
    as_read: float
    """Agreement as read."""
    other: float
    """Agreement under the other reading that gains most."""
    gain: float
    """What it gains, over all points and over those that fall on a measured depth, whichever is
    less: a camera that moves along a wall loses points at the edge of its view, and one that stands
    still would not."""
    reading: str
    """That reading, in words."""
    colour: float
    """Mean difference of brightness between the points that agree in depth, relative to that
    between the pixels in the same place: near 0 where pictures move as depth does, 1 where they do
    not; NaN where nothing moves or can be seen."""


def agreement_of(
    frames: Sequence[SmallFrame], poses: Sequence[Float[Tensor, "4 4"]]
) -> FirstAgreement:
    """Measure how well frames with the same camera agree with each other, in pairs ``GAPS`` apart.

    Args:
        frames: At least two, in order.
        poses: Their camera-to-world poses.
    """
    places = [(i, i + gap) for gap in GAPS for i in range(len(frames) - gap)]
    pairs = pairs_of(frames, poses, places)
    as_is = pairs.moved()
    error = as_is.residual.abs()
    total = max(1, int((pairs.depth_a > 0).sum()))
    usual = float(error[as_is.known].median()) if bool(as_is.known.any()) else math.nan
    tolerance = min(max(3 * usual, 0.002), 0.06) if math.isfinite(usual) else 0.06

    def agreement(points: Reprojection) -> tuple[float, float]:
        """Over all points, and over those that fall on a measured depth."""
        whole = float(((1 - points.residual.abs() / tolerance).clamp_min(0) * points.known).sum())
        return whole / total, whole / max(1, int(points.known.sum()))

    as_read, of_known = agreement(as_is)
    others = {words: agreement(read(pairs)) for words, read in READINGS.items()}
    gains = {
        words: min(whole - as_read, of_measured - of_known)
        for words, (whole, of_measured) in others.items()
    }
    reading = max(gains, key=lambda words: gains[words])
    agrees = as_is.known & (error < AGREES)
    return FirstAgreement(
        share=int(agrees.sum()) / total,
        overlap=int(as_is.known.sum()) / total,
        as_read=as_read,
        other=others[reading][0],
        gain=gains[reading],
        reading=reading,
        colour=_colour(frames, places, pairs, as_is.uv_b, agrees),
    )


def colour_difference(frames: Sequence[SmallFrame], poses: Sequence[Float[Tensor, "4 4"]]) -> float:
    """``FirstAgreement.colour`` alone, of frames with the same camera; arguments as for
    ``agreement_of``."""
    places = [(i, i + gap) for gap in GAPS for i in range(len(frames) - gap)]
    if not places:
        return math.nan
    pairs = pairs_of(frames, poses, places)
    as_is = pairs.moved()
    agrees = as_is.known & (as_is.residual.abs() < AGREES)
    return _colour(frames, places, pairs, as_is.uv_b, agrees)


def _colour(
    frames: Sequence[SmallFrame],
    places: Sequence[tuple[int, int]],
    pairs: Pairs,
    uv_b: Float[Tensor, "P N 2"],
    agrees: Tensor,
) -> float:
    """``FirstAgreement.colour``; of each pair the brightness is compared after its ratio."""
    with_motion = []
    without_motion = []
    width = pairs.camera.width
    for j, (first, second) in enumerate(places):
        at = pairs.uv_a[j][agrees[j]]
        to = uv_b[j][agrees[j]]
        if not len(at) or float((to - at).norm(dim=-1).median()) < MOVED_PX:
            continue
        a = greys_at(frames[first].grey, at, width)
        b, same_place = (greys_at(frames[second].grey, uv, width) for uv in (to, at))
        good = is_usable_grey(a, b, same_place)
        if good.sum() >= FEWEST_GREYS:
            with_motion.append(_difference(a[good], b[good]))
            without_motion.append(_difference(a[good], same_place[good]))
    if len(without_motion) < _LEAST_COLOUR_PAIRS or np.mean(without_motion) < _LEAST_CONTRAST:
        return math.nan
    return float(np.mean(with_motion) / np.mean(without_motion))


def _difference(
    a: Float[np.ndarray, " N"],
    b: Float[np.ndarray, " N"],
) -> float:
    return float(np.minimum(np.abs(b / 2 ** gain_stops(a, b) - a), _MOST_DIFFERENCE).mean())
