"""Pinhole projection and its inverse, in the convention of the whole package.

| quantity | name | convention |
|---|---|---|
| pose | ``T_WC``, ``T_CW`` | camera-to-world 4x4 and its inverse; OpenCV axes (x right, y down, z forward); metres |
| pixel | ``uv`` | continuous; the centre of pixel (i, j) is (i + 0.5, j + 0.5) |
| depth | ``depth_m`` | z-depth, metres, 0 = missing, never NaN; ``range_m`` is the length along the ray |
| image | ``rgb`` | [H, W, 3], 0..1; ``rgb_u8`` the same in bytes, as an 8-bit image is carried |
| TSDF | ``D``, ``W`` | D in units of the truncation distance, positive in front of the surface; W observation count |
| rotation | ``quat`` | wxyz, normalised at use |
| Gaussians | ``xyz_W, log_scale, quat, opacity_logit, sh`` | activated ones are ``scale_m``, ``opacity``, ``rgb`` |
| gradient | ``v_x`` | dL/dx, from ``<operation>_vjp`` |
| randomness | ``generator`` | passed in; a run with a seed repeats exactly on one machine and thread count |

A data set whose intrinsics put pixel centres at integers (TUM, 7-Scenes, Replica) gets +0.5 on cx and cy in its reader.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from ..types import Camera


def pixel_grid(camera: Camera, *, device=None, dtype=torch.float32) -> Float[Tensor, "H W 2"]:
    """Pixel centres ``uv`` of the whole image. [H, W, 2]"""
    u = torch.arange(camera.width, device=device, dtype=dtype) + 0.5
    v = torch.arange(camera.height, device=device, dtype=dtype) + 0.5
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)


def rays(camera: Camera, uv: Float[Tensor, "*N 2"]) -> Float[Tensor, "*N 3"]:
    """Directions through ``uv`` with z = 1, camera frame: a point is depth_m * ray."""
    x = (uv[..., 0] - camera.cx) / camera.fx
    y = (uv[..., 1] - camera.cy) / camera.fy
    return torch.stack([x, y, torch.ones_like(x)], dim=-1)


def backproject(camera: Camera, uv: Float[Tensor, "*N 2"], depth_m: Float[Tensor, "*N"]) -> Float[Tensor, "*N 3"]:
    """Camera-frame points at z-depth ``depth_m`` at the pixels ``uv`` (GSFusion Eq. 10, before T_WC).

    Differentiable: yes, through torch.
    """
    return rays(camera, uv) * depth_m[..., None]


def project(camera: Camera, xyz_C: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 2"]:
    """Pixel coordinates of camera-frame points (GSFusion Eq. 4). Points with z <= 0 give meaningless pixels.

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
