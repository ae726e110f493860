"""Depth images of a triangle mesh, without a graphics card or display."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...geometry import se3
from ...types import Camera

NEAR_M = 0.02
_SAMPLES = 1 << 21
"""Pixels of triangles processed at once; limits the memory."""


def mesh_depth(
    vertices_W: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], camera: Camera, T_WC: Float[Tensor, "4 4"]
) -> Float[Tensor, "H W"]:
    """z-depth of the first triangle that the ray through each pixel's centre meets, from either side.

    With a triangle's corners P0, P1, P2 in the camera frame, the ray t r, r = (x, y, 1), meets it where the three edge
    functions e_i = (P_j x P_k) . r have the sign of det = P0 . n, n = (P1 - P0) x (P2 - P0); there
    1/t = (n . r) / det. Nothing is projected, so a triangle may reach behind the camera; two triangles that share an
    edge leave no gap, since their edge functions are exact negatives.

    Args:
        vertices_W: World frame, metres. [V, 3]
        faces: Vertex numbers. [F, 3]
        camera: Intrinsics.
        T_WC: Camera-to-world pose. [4, 4]

    Returns:
        z-depth, metres, 0 where the ray does not meet the mesh, or nearer than 2 cm. [H, W] float32

    Differentiable: no. Source: Olano & Greer 1997, "Triangle scan conversion using 2D homogeneous coordinates".
    """
    P = se3.apply(se3.inverse(T_WC.double()), vertices_W.double())[faces.long()]
    P = P[(P[..., 2] > NEAR_M).any(dim=1)]
    low, high = _pixel_bounds(P, camera)
    size = high - low + 1
    seen = (size > 0).all(dim=1)
    P, low, high, size = P[seen], low[seen], high[seen], size[seen]
    edges = torch.stack([_cross(P[:, i - 2], P[:, i - 1]) for i in range(3)], dim=1)
    n = _cross(P[:, 1] - P[:, 0], P[:, 2] - P[:, 0])
    det = (P[:, 0] * n).sum(-1)
    plane = n / det.where(det != 0, torch.ones_like(det))[:, None]
    edges = (edges * det.sign()[:, None, None]).float()
    plane = torch.where(det[:, None] != 0, plane, torch.zeros_like(plane)).float()
    nearest = torch.zeros(camera.height * camera.width, device=P.device)  # inverse depth
    power = torch.ceil(torch.log2(size.double())).long()
    for key in torch.unique(power, dim=0).tolist():
        nx, ny = 2 ** key[0], 2 ** key[1]
        rows = torch.nonzero((power == torch.tensor(key, device=P.device)).all(dim=1)).squeeze(1)
        for part in rows.split(max(1, _SAMPLES // (nx * ny))):
            _draw(nearest, camera, edges[part], plane[part], low[part], high[part], (nx, ny))
    return torch.where(nearest > 0, 1.0 / nearest.clamp(min=1e-12), 0.0).reshape(camera.height, camera.width)


def _cross(a: Float[Tensor, "F 3"], b: Float[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    # In one fixed order, so that b x a is exactly -(a x b) which the library's function does not guarantee.
    i, j = [1, 2, 0], [2, 0, 1]
    return a[:, i] * b[:, j] - a[:, j] * b[:, i]


def _pixel_bounds(P: Float[Tensor, "F 3 3"], camera: Camera) -> tuple[Int[Tensor, "F 2"], Int[Tensor, "F 2"]]:
    """First and last pixel (column, row) whose centre may lie in each triangle; cut at the near plane and the image."""
    front = P[..., 2] >= NEAR_M
    after = P[:, [1, 2, 0]]
    gap = after[..., 2] - P[..., 2]
    crosses = front != front[:, [1, 2, 0]]
    s = torch.where(crosses, (NEAR_M - P[..., 2]) / gap.where(crosses, torch.ones_like(gap)), 0.0)
    points = torch.cat([P, P + s[..., None] * (after - P)], dim=1)
    counts = torch.cat([front, crosses], dim=1)[..., None]
    z = points[..., 2:].clamp(min=0.5 * NEAR_M)
    focal = points.new_tensor([camera.fx, camera.fy])
    uv = points[..., :2] / z * focal + points.new_tensor([camera.cx, camera.cy])
    limit = points.new_tensor([camera.width, camera.height])
    low = uv.where(counts, torch.inf).amin(dim=1)
    high = uv.where(counts, -torch.inf).amax(dim=1)
    # A thousandth of a pixel too wide, because the edge functions decide exactly.
    first = torch.ceil((low - 0.501).clamp(min=0)).minimum(limit)
    last = torch.floor((high - 0.499).clamp(min=-1)).minimum(limit - 1)
    return first.long(), last.long()


def _draw(
    nearest: Float[Tensor, " P"],
    camera: Camera,
    edges: Float[Tensor, "F 3 3"],
    plane: Float[Tensor, "F 3"],
    low: Int[Tensor, "F 2"],
    high: Int[Tensor, "F 2"],
    size: tuple[int, int],
) -> None:
    """Raise the inverse depths in ``nearest`` to those of some triangles, each within ``size`` pixels from ``low``."""
    column = low[:, 0, None] + torch.arange(size[0], device=low.device)
    row = low[:, 1, None] + torch.arange(size[1], device=low.device)
    x = (column + 0.5 - camera.cx) / camera.fx
    y = (row + 0.5 - camera.cy) / camera.fy
    inside = (column <= high[:, :1])[:, None, :] & (row <= high[:, 1:])[:, :, None]
    for k in range(3):
        inside &= _linear(edges[:, k], x, y) >= 0
    w = _linear(plane, x, y)
    inside &= (w > 0) & (w < 1.0 / NEAR_M)
    pixel = row[:, :, None] * camera.width + column[:, None, :]
    nearest.scatter_reduce_(0, pixel[inside], w[inside], reduce="amax")


def _linear(a: Float[Tensor, "F 3"], x: Float[Tensor, "F w"], y: Float[Tensor, "F h"]) -> Float[Tensor, "F h w"]:
    return (a[:, :1] * x)[:, None, :] + (a[:, 1:2] * y + a[:, 2:])[:, :, None]
