"""Surface normals of a depth image."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..types import Camera
from .camera import backproject, depth_to_points


def depth_to_normals(
    camera: Camera, depth_m: Float[Tensor, "H W"], *, max_jump: float = 0.05
) -> Float[Tensor, "H W 3"]:
    """Unit normals that point towards the camera, camera frame; zero where unknown. [H, W, 3]

    Cross product of central differences of the back-projected points. A pixel has no normal if its depth or that of one
    of its four neighbours is missing, or if a neighbour's depth differs by more than ``max_jump`` times its own (a
    depth edge).
    """
    P = depth_to_points(camera, depth_m)
    normal = torch.zeros_like(P)
    if min(depth_m.shape) < 3:
        return normal
    neighbours = (depth_m[1:-1, 2:], depth_m[1:-1, :-2], depth_m[2:, 1:-1], depth_m[:-2, 1:-1])
    known = _on_one_surface(depth_m[1:-1, 1:-1], neighbours, max_jump)
    n = _towards_camera(P[1:-1, 2:] - P[1:-1, :-2], P[2:, 1:-1] - P[:-2, 1:-1])
    normal[1:-1, 1:-1] = n * known[..., None]
    return normal


def normals_at(
    camera: Camera,
    depth_m: Float[Tensor, "H W"],
    row: Int[Tensor, " N"],
    column: Int[Tensor, " N"],
    *,
    max_jump: float = 0.05,
) -> Float[Tensor, "N 3"]:
    """``depth_to_normals`` of some pixels only: faster than all of them, and equal to rounding."""
    H, W = depth_m.shape
    inside = (row > 0) & (row < H - 1) & (column > 0) & (column < W - 1)
    depths, points = [], []
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        y, x = (row + down).clamp(0, H - 1), (column + right).clamp(0, W - 1)
        depths.append(depth_m[y, x])
        points.append(backproject(camera, torch.stack([x, y], dim=-1) + 0.5, depths[-1]))
    known = inside & _on_one_surface(depth_m[row, column], depths, max_jump)
    return _towards_camera(points[0] - points[1], points[2] - points[3]) * known[:, None]


def _on_one_surface(d: Float[Tensor, "*N"], neighbours: Sequence[Tensor], max_jump: float) -> Bool[Tensor, "*N"]:
    known = d > 0
    for n in neighbours:
        known = known & (n > 0) & ((n - d).abs() <= max_jump * d)
    return known


def _towards_camera(dx: Float[Tensor, "*N 3"], dy: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
    n = torch.linalg.cross(dy, dx)  # y down, x right: in this order the normal points towards the camera
    return n / n.norm(dim=-1, keepdim=True).clamp_min(1e-12)
