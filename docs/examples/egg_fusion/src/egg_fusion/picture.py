"""What a camera sees of surfels: colour, depth and normal of each pixel, with gradients by
autograd."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gsfusion_nb.geometry import pixel_grid, rays, se3
from gsfusion_nb.render import render_autograd
from gsfusion_nb.types import Camera, GaussianParams

from .surfel_filter import normals_of

STEEP = 0.1
"""A surfel whose normal is more than 84 degrees away from the ray to its centre is drawn at the
depth of its centre."""
SHOWN = 0.5
"""Where less is covered there is no surface."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfelPicture:
    """What a camera sees of a map of surfels."""

    rgb: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    depth_m: Float[Tensor, "H W"]
    """z-depth of the surface, metres; 0 where there is none."""
    normal_W: Float[Tensor, "H W 3"]
    """Unit normal towards the camera, world frame; 0 where there is no surface."""


def draw(params: GaussianParams, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> SurfelPicture:
    """Blend colours, normals and the planes of surfels.

    A ray r with r_z = 1 meets the plane of a surfel at the depth z = n.p / n.r, camera frame. Its
    inverse depth (n / n.p).r is linear in r, so three numbers of each surfel are blended for it.
    """
    T_WC = T_WC.to(params.xyz_W)
    T_CW = se3.inverse(T_WC)
    p = se3.apply(T_CW, params.xyz_W)
    n = se3.rotate(T_CW, normals_of(params.quat))
    n = torch.where((n * p).sum(dim=1, keepdim=True) > 0, -n, n)
    offset = (n * p).sum(dim=1, keepdim=True)
    is_steep = offset.abs() > STEEP * p.norm(dim=1, keepdim=True)
    z = p[:, 2:].clamp_min(1e-6)
    flat = torch.cat([torch.zeros_like(p[:, :2]), 1 / z], dim=1)
    plane = torch.where(is_steep, n / torch.where(is_steep, offset, 1.0), flat)
    seen = render_autograd(params, camera, T_WC, features=torch.cat([n, plane], dim=1))
    assert seen.features is not None
    r = rays(camera, pixel_grid(camera, device=p.device, dtype=p.dtype))
    inverse_depth = (seen.features[..., 3:] * r).sum(dim=-1)
    is_surface = (seen.alpha > SHOWN) & (inverse_depth > 1e-6)
    depth_m = torch.where(is_surface, seen.alpha / torch.where(is_surface, inverse_depth, 1.0), 0.0)
    normal_W = se3.rotate(T_WC, torch.nn.functional.normalize(seen.features[..., :3], dim=-1))
    return SurfelPicture(
        rgb=seen.rgb,
        alpha=seen.alpha,
        depth_m=depth_m,
        normal_W=torch.where(is_surface[..., None], normal_W, 0.0),
    )
