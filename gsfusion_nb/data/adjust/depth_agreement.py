"""How well the depth of one frame predicts that of another: points of one depth image are moved
into another under one or many relative poses.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ...geometry import depth_to_points, project, se3
from ...types import Camera, Frame

AGREES = 0.03
"""A point agrees when its depth differs by less than this share: a Kinect's noise at 4 m is 1 to 2
per cent."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthConsistency:
    """How well two depth images agree under one or each of K relative poses."""

    agreeing: Float[Tensor, "*K"]
    """Share of ``a``'s points that fall on a depth of ``b`` which differs by less than 3 per
    cent."""
    overlap: Float[Tensor, "*K"]
    """Share of ``a``'s points that fall on a valid depth of ``b``."""
    median_m: Float[Tensor, "*K"]
    """Median absolute difference of z-depth over those points, metres; NaN if there are none."""
    score: Float[Tensor, "*K"]
    """Mean of max(0, 1 - difference / 3 per cent) over all points: 1 for exact agreement
    everywhere."""


def sparse_points(
    camera: Camera,
    depth_m: Float[Tensor, "H W"],
    step: int,
) -> Float[Tensor, "N 3"]:
    """Points of every ``step``-th pixel in both directions that has depth, in the camera's frame,
    metres."""
    sparse = slice(step // 2, None, step)
    points = depth_to_points(camera, depth_m)[sparse, sparse].reshape(-1, 3)
    return points[points[:, 2] > 0]


def depth_consistency(
    xyz_a: Float[Tensor, "N 3"],
    depth_b: Float[Tensor, "H W"],
    camera: Camera,
    T_ba: Float[Tensor, "*K 4 4"],
) -> DepthConsistency:
    """Move the points of ``a`` into ``b`` under each pose and compare with the depth of the pixel
    they fall on.

    Args:
        xyz_a: Points in the frame of camera ``a``, metres (``sparse_points``). [N, 3]
        depth_b: z-depth of ``b``, metres, 0 = missing. [H, W]
        camera: Of ``depth_b``.
        T_ba: Transforms from camera ``a`` to camera ``b``. [*K, 4, 4]
    """
    T = T_ba.to(xyz_a.dtype)
    R = T[..., :3, :3]
    t = T[..., None, :3, 3]
    P = xyz_a @ R.mT + t
    z = P[..., 2]
    front = z > 1e-6
    uv = project(
        camera,
        torch.where(front[..., None], P, torch.ones_like(P)),
    )
    u, v = uv.floor().unbind(-1)
    in_width = (u >= 0) & (u < camera.width)
    in_height = (v >= 0) & (v < camera.height)
    is_inside = front & in_width & in_height
    row = v.where(is_inside, 0.0).long()
    column = u.where(is_inside, 0.0).long()
    depth_there = depth_b[row, column]
    has_depth = is_inside & (depth_there > 0)
    error = (z - depth_there).abs()
    tolerance_m = AGREES * depth_there.clamp_min(1e-9)
    unit = (error / tolerance_m).where(has_depth, torch.inf)
    total = max(xyz_a.shape[0], 1)
    median_m = torch.full(T.shape[:-2], torch.nan)
    if len(xyz_a):
        median_m = error.where(has_depth, torch.nan).nanmedian(dim=-1).values
    return DepthConsistency(
        agreeing=(unit < 1).sum(-1) / total,
        overlap=has_depth.sum(-1) / total,
        median_m=median_m,
        score=(1 - unit).clamp_min(0).sum(-1) / total,
    )


def thinned(
    camera: Camera, depth_m: Float[Tensor, "H W"], step: int
) -> tuple[Camera, Float[Tensor, "h w"]]:
    """Every ``step``-th pixel of a depth image as a smaller image with the same rays; nothing is
    interpolated."""
    first = (step - 1) // 2
    small = depth_m[first::step, first::step]
    height, width = small.shape
    small_camera = replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx / step,
        fy=camera.fy / step,
        cx=(camera.cx - first - 0.5) / step + 0.5,
        cy=(camera.cy - first - 0.5) / step + 0.5,
    )
    return small_camera, small


def relative_poses(
    T_WA: Float[Tensor, "*K 4 4"], T_WB: Float[Tensor, "*K 4 4"]
) -> Float[Tensor, "*K 4 4"]:
    """Transforms from camera A to camera B. [*K, 4, 4]"""
    return se3.inverse(T_WB) @ T_WA


def depth_agreement(a: Frame, b: Frame, *, step: int = 4) -> DepthConsistency:
    """Move the points of frame ``a`` into frame ``b`` and compare with the depth measured there.

    Args:
        a, b: Two frames with the same world frame and camera.
        step: Every step-th pixel of ``a`` in both directions is used.
    """
    T_ba = relative_poses(a.T_WC.double(), b.T_WC.double())
    return depth_consistency(
        sparse_points(b.camera, a.depth_m, step),
        b.depth_m,
        b.camera,
        T_ba,
    )
