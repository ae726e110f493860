"""Surface normals of a depth image."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..types import Camera
from .camera import depth_to_points


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
    d = depth_m[1:-1, 1:-1]
    neighbours = (depth_m[1:-1, 2:], depth_m[1:-1, :-2], depth_m[2:, 1:-1], depth_m[:-2, 1:-1])
    known = d > 0
    for n in neighbours:
        known = known & (n > 0) & ((n - d).abs() <= max_jump * d)
    dx = P[1:-1, 2:] - P[1:-1, :-2]
    dy = P[2:, 1:-1] - P[:-2, 1:-1]
    n = torch.linalg.cross(dy, dx)  # y down, x right: in this order the normal points towards the camera
    n = n / n.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    normal[1:-1, 1:-1] = n * known[..., None]
    return normal
