"""What a camera sees of the volume: march every ray to the surface (KinectFusion, Newcombe et al.
2011).

The points of a ray are x(z) = o + z r, with the camera's centre o and r of length 1 along the
camera's axis. A ray advances by a share s of the stored distance (truncation distance mu), by a
voxel v at least, and across a block that is not allocated in one step:

    z <- z + max(s mu |D(x)|, v) / |r|                                                     (1)

The surface is between the first two samples z0, z1 with D0 >= 0 > D1, where a straight line through
them is zero:

    z* = z0 + (z1 - z0) D0 / (D0 - D1)                                                     (2)

Its normal is the direction of the gradient of D. D is read in two ways: of the voxel that holds x,
which is quick and says how far the ray may go; and trilinear between the eight voxels around x,
close to a surface and in (2).
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..backends import op
from ..checks import check_pose
from ..geometry import pixel_grid, rays, se3
from ..geometry.operands import check_view
from ..types import Camera
from .cells import cell_corners, corner_gradients, corner_weights
from .volume import TsdfVolume, check_volume, is_observed, rgb_at
from .voxels import block_corners

STEP = 0.7
"""s in (1). Below 1, because D was measured along other rays and overestimates the true
distance."""

CLOSE_VOXELS = 2.0
"""Closer to a surface, marching uses the interpolated D, because the sign of the nearest voxel can
be wrong there."""

REFINEMENTS = 2
"""How often (2) is computed again, with the interpolated D at the last z* in place of the end with
the same sign."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RaycastOutput:
    """The surface as a camera sees it; all zero where no ray meets one."""

    depth_m: Float[Tensor, "H W"]
    """z-depth, metres."""
    normal_W: Float[Tensor, "H W 3"]
    """Unit normal towards the free side, world frame: the gradient of D."""
    rgb: Float[Tensor, "H W 3"]
    """Mean colour, 0..1."""


def check_raycast(volume: Any, camera: Any, T_WC: Any) -> None:
    """Raise ``ValueError`` for arguments that ``raycast`` refuses."""
    check_volume(volume)
    check_view(camera, T_WC, volume.D.device)
    check_pose("T_WC", T_WC)


@op("raycast", check_raycast)
def raycast(volume: TsdfVolume, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RaycastOutput:
    """Depth, normals and colour of the zero crossing of D, as seen from a pose.

    Each ray advances by (1) and stops where D changes from + to -. A ray on which D changes from -
    to + has met the back of a surface and ends there without a result.

    Args:
        volume: The map.
        camera: Intrinsics and size of the image.
        T_WC: Camera-to-world pose.

    Raises:
        ValueError: the pose is not rigid.

    Differentiable: no.
    """
    T_WC = T_WC.to(volume.device, torch.float32)
    H = camera.height
    W = camera.width
    n = camera.height * camera.width
    depth_m, normal_W, rgb = (
        torch.zeros(n, *channels, device=volume.device) for channels in ((), (3,), (3,))
    )
    if volume.n_blocks:
        ray_C = rays(camera, pixel_grid(camera, device=volume.device))
        ray_W = se3.rotate(T_WC, ray_C).view(n, 3)
        z = _surface_depths(volume, T_WC, ray_W)
        point_W = T_WC[:3, 3] + z.nan_to_num()[:, None] * ray_W
        at, f = cell_corners(volume, point_W)
        hit = is_observed(volume, at).all(1) & ~z.isnan()
        at = at[hit]
        f = f[hit]
        depth_m[hit] = z[hit]
        D = volume.D.view(-1)[at]
        gradient = (D[..., None] * corner_gradients(f)).sum(1)
        normal_W[hit] = torch.nn.functional.normalize(gradient, dim=1)
        rgb[hit] = (rgb_at(volume, at) * corner_weights(f)[..., None]).sum(1)
    return RaycastOutput(
        depth_m=depth_m.view(H, W),
        normal_W=normal_W.view(H, W, 3),
        rgb=rgb.view(H, W, 3),
    )


def _surface_depths(
    volume: TsdfVolume, T_WC: Float[Tensor, "4 4"], ray_W: Float[Tensor, "R 3"]
) -> Float[Tensor, " R"]:
    """Depth at which each ray first changes from the free side of a surface to its inside, NaN
    where none does."""
    origin_W = T_WC[:3, 3]
    voxel_m = volume.config.voxel_size_m
    truncation_m = volume.config.truncation_m
    T_CW = se3.inverse(T_WC.double())
    z_blocks = se3.apply(T_CW, block_corners(volume.block_coords, volume.block_size_m))[..., 2]
    z_last = float(z_blocks.max())
    depth = ray_W.new_full((len(ray_W),), torch.nan)
    ray = torch.arange(len(ray_W), device=ray_W.device)  # those that are still on their way
    z = ray_W.new_full((len(ray_W),), max(float(z_blocks.min()), 0.0))
    z_before = z
    D_before = torch.full_like(z, torch.nan)
    while len(ray):
        r = ray_W[ray]
        point_W = origin_W + z[:, None] * r
        D, allocated = _distance_at(volume, point_W)
        enters = (D_before >= 0) & (D < 0)
        leaves = (D_before < 0) & (D >= 0)
        bracket = [t[enters] for t in (z_before, z, D_before, D)]
        depth[ray[enters]] = _zero_crossing(volume, origin_W, r[enters], bracket)
        free_m = (STEP * truncation_m * D.abs()).nan_to_num(0.0).clamp(min=voxel_m)
        # (1)
        step = torch.where(allocated, free_m / r.norm(dim=1), _to_block_exit(volume, point_W, r))
        goes_on = ~enters & ~leaves & (z + step < z_last)
        ray = ray[goes_on]
        z_before = z[goes_on]
        D_before = D[goes_on]
        z = (z + step)[goes_on]
    return depth


def _distance_at(
    volume: TsdfVolume, point_W: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, " N"], Bool[Tensor, " N"]]:
    """D at points, NaN where not observed; and whether their block is allocated."""
    voxel = volume.find_voxels(volume.voxel_index(point_W))
    nearest = volume.D.view(-1)[voxel].where(is_observed(volume, voxel), torch.nan)
    close = nearest.abs() * volume.config.truncation_m < CLOSE_VOXELS * volume.config.voxel_size_m
    interpolated, valid = volume.interpolate(point_W[close])
    D = nearest.clone()
    D[close] = interpolated.where(valid, nearest[close])
    return D, voxel >= 0


def _to_block_exit(
    volume: TsdfVolume, point_W: Float[Tensor, "N 3"], ray_W: Float[Tensor, "N 3"]
) -> Float[Tensor, " N"]:
    """Depth to add so that each point leaves its block, plus a hundredth of a voxel to be surely
    outside."""
    p = point_W / volume.block_size_m
    to_wall = torch.where(
        ray_W > 0,
        p.floor() + 1 - p,
        p - p.floor(),
    )
    to_wall_m = to_wall * volume.block_size_m
    to_exit = (to_wall_m / ray_W.abs().clamp(min=1e-9)).amin(1)
    return to_exit + 0.01 * volume.config.voxel_size_m


def _zero_crossing(
    volume: TsdfVolume,
    origin_W: Float[Tensor, " 3"],
    ray_W: Float[Tensor, "N 3"],
    bracket: list[Tensor],
) -> Float[Tensor, " N"]:
    """Depth of the zero of D inside a bracket (depths before and behind, D before and behind).

    Equation (2), then again in the part of the bracket where the sign of the interpolated D changes
    (regula falsi).
    """
    z0, z1, D0, D1 = bracket
    z = z0 + (z1 - z0) * D0 / (D0 - D1)
    for _ in range(REFINEMENTS):
        D, valid = volume.interpolate(origin_W + z[:, None] * ray_W)
        before = valid & (D >= 0)
        behind = valid & (D < 0)
        z0 = z.where(before, z0)
        D0 = D.where(before, D0)
        z1 = z.where(behind, z1)
        D1 = D.where(behind, D1)
        z = z0 + (z1 - z0) * D0 / (D0 - D1)
    return z
