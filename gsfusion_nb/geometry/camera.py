"""Pinhole projection, its inverse, and normals of a depth image, in the convention of the whole
package.

    pose        T_WC, T_CW   camera-to-world 4x4 and its inverse, metres;
                             OpenCV axes: x right, y down, z forward
    pixel       uv           continuous; the centre of pixel (i, j) is (i + 0.5, j + 0.5)
    depth       depth_m      z-depth, metres, 0 = missing, never NaN
                range_m      length along the ray, metres
    image       rgb          [H, W, 3], 0..1
                rgb_u8       the same in bytes, as an 8-bit image is carried
    TSDF        D            signed distance in units of the truncation distance,
                             positive in front of the surface
                W            observation count
    rotation    quat         wxyz, normalised at use
    Gaussians   xyz_W, log_scale, quat, opacity_logit, sh
                             stored; activated ones are scale_m, opacity, rgb
    gradient    v_x          dL/dx, from <operation>_vjp
    randomness  generator    passed in; a run with a seed repeats exactly on one machine
                             and thread count

A data set whose intrinsics put pixel centres at integers (TUM, 7-Scenes, Replica) gets +0.5 on cx
and cy in its reader.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..types import Camera


def pixel_grid(
    camera: Camera,
    *,
    device=None,
    dtype=torch.float32,
) -> Float[Tensor, "H W 2"]:
    """Pixel centres ``uv`` of the whole image. [H, W, 2]"""
    u = torch.arange(camera.width, device=device, dtype=dtype) + 0.5
    v = torch.arange(camera.height, device=device, dtype=dtype) + 0.5
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)


def rays(camera: Camera, uv: Float[Tensor, "*N 2"]) -> Float[Tensor, "*N 3"]:
    """Directions through ``uv`` with z = 1, camera frame: a point is depth_m * ray."""
    x = (uv[..., 0] - camera.cx) / camera.fx
    y = (uv[..., 1] - camera.cy) / camera.fy
    return torch.stack([x, y, torch.ones_like(x)], dim=-1)


def backproject(
    camera: Camera, uv: Float[Tensor, "*N 2"], depth_m: Float[Tensor, "*N"]
) -> Float[Tensor, "*N 3"]:
    """Camera-frame points at z-depth ``depth_m`` at the pixels ``uv`` (GSFusion Eq. 10, before
    T_WC).

    Differentiable: yes, through torch.
    """
    return rays(camera, uv) * depth_m[..., None]


def project(camera: Camera, xyz_C: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 2"]:
    """Pixel coordinates of camera-frame points (GSFusion Eq. 4). Points with z <= 0 give
    meaningless pixels.

    Differentiable: yes, through torch.
    """
    z = xyz_C[..., 2]
    u = camera.fx * xyz_C[..., 0] / z + camera.cx
    v = camera.fy * xyz_C[..., 1] / z + camera.cy
    return torch.stack([u, v], dim=-1)


def depth_to_points(camera: Camera, depth_m: Float[Tensor, "H W"]) -> Float[Tensor, "H W 3"]:
    """Camera-frame point of every pixel; the origin where depth is missing. [H, W, 3]"""
    uv = pixel_grid(camera, device=depth_m.device, dtype=depth_m.dtype)
    return backproject(camera, uv, depth_m)


def depth_to_normals(
    camera: Camera, depth_m: Float[Tensor, "H W"], *, max_jump: float = 0.05
) -> Float[Tensor, "H W 3"]:
    """Unit normals that point towards the camera, camera frame; zero where unknown. [H, W, 3]

    Cross product of central differences of the back-projected points. A pixel has no normal if its
    depth or that of one of its four neighbours is missing, or if a neighbour's depth differs by
    more than ``max_jump`` times its own (a depth edge).
    """
    P = depth_to_points(camera, depth_m)
    normal = torch.zeros_like(P)
    if min(depth_m.shape) < 3:
        return normal
    neighbours = (depth_m[1:-1, 2:], depth_m[1:-1, :-2], depth_m[2:, 1:-1], depth_m[:-2, 1:-1])
    has_normal = _on_one_surface(depth_m[1:-1, 1:-1], neighbours, max_jump)
    dx = P[1:-1, 2:] - P[1:-1, :-2]
    dy = P[2:, 1:-1] - P[:-2, 1:-1]
    n = _towards_camera(dx, dy)
    normal[1:-1, 1:-1] = n * has_normal[..., None]
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
    inside_rows = (row > 0) & (row < H - 1)
    inside_columns = (column > 0) & (column < W - 1)
    has_neighbours = inside_rows & inside_columns
    depths = []
    points = []
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        y = (row + dy).clamp(0, H - 1)
        x = (column + dx).clamp(0, W - 1)
        depths.append(depth_m[y, x])
        uv = torch.stack([x, y], dim=-1) + 0.5
        points.append(backproject(camera, uv, depths[-1]))
    has_normal = has_neighbours & _on_one_surface(depth_m[row, column], depths, max_jump)
    return _towards_camera(points[0] - points[1], points[2] - points[3]) * has_normal[:, None]


def _on_one_surface(
    d: Float[Tensor, "*N"], neighbours: Sequence[Tensor], max_jump: float
) -> Bool[Tensor, "*N"]:
    is_on_one = d > 0
    for n in neighbours:
        is_on_one = is_on_one & (n > 0) & ((n - d).abs() <= max_jump * d)
    return is_on_one


def _towards_camera(
    dx: Float[Tensor, "*N 3"],
    dy: Float[Tensor, "*N 3"],
) -> Float[Tensor, "*N 3"]:
    # y down, x right: in this order the normal points towards the camera
    n = torch.linalg.cross(dy, dx)
    return n / n.norm(dim=-1, keepdim=True).clamp_min(1e-12)
