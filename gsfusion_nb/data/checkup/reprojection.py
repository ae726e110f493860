"""Points of one depth image moved into another: how many agree with the depth there, for many poses at once."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ...geometry import depth_to_points, project, se3
from ...types import Camera

AGREES = 0.03
"""A point agrees when its depth differs by less than this share: a Kinect's noise at 4 m is 1 to 2 per cent."""


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
