"""What a camera sees of the volume: march every ray to the surface."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..backends import op
from ..checks import check_pose
from ..geometry import se3
from ..types import Camera
from .allocate import ray_slopes
from .volume import TsdfVolume, corner_weights

STEP = 0.7
"""Part of the stored distance to advance. D was measured along other rays and overstates the true distance."""

CLOSE_VOXELS = 2.0
"""Nearer to a surface than this, marching looks at the interpolated D: the nearest voxel's sign can be wrong there."""

REFINEMENTS = 2
"""Interpolations after the first, linear one."""

TILE_PX = 16
"""Edge of the picture tiles whose rays start together, pixels."""

_HIDDEN, _FREE, _INSIDE = 0, 1, 2


@dataclass(frozen=True, kw_only=True, eq=False)
class RaycastOutput:
    """The surface as a camera sees it; all zero where no ray meets one."""

    depth_m: Float[Tensor, "H W"]
    """z-depth, metres."""
    normal_W: Float[Tensor, "H W 3"]
    """Unit normal towards the free side, world frame: the gradient of D."""
    rgb: Float[Tensor, "H W 3"]
    """Mean colour, 0..1."""


@op("raycast")
def raycast(volume: TsdfVolume, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RaycastOutput:
    """Depth, normals and colour of the zero crossing of D, as seen from a pose.

    Each ray starts where the first block can be, leaps over what is not allocated, advances by a part of the stored
    distance, and stops at the first change from + to -, where D is interpolated linearly. A ray that leaves the inside
    of a surface (- to +) looks at its back and ends there without a result (KinectFusion, Newcombe et al. 2011).

    Args:
        volume: The map.
        camera: Intrinsics and size of the picture.
        T_WC: Camera-to-world pose.

    Differentiable: no.
    """
    check_pose("T_WC", T_WC)
    T_WC = T_WC.to(volume.device)
    H, W = camera.height, camera.width
    depth = torch.zeros(H * W, device=volume.device)
    normal, rgb = torch.zeros(H * W, 3, device=volume.device), torch.zeros(H * W, 3, device=volume.device)
    if volume.n_blocks:
        x, y = ray_slopes(camera, depth.view(H, W))
        direction = torch.stack([x, y, torch.ones_like(x)], dim=-1).view(-1, 3)
        direction_W = se3.rotate(T_WC.to(depth.dtype), direction)
        origin_W = T_WC[:3, 3].to(depth.dtype)
        z_first, z_last = (plane.view(-1) for plane in _depth_range(volume, camera, T_WC))
        ray, z = _march(volume, origin_W, direction_W, z_first, z_last)
        hit, values = _surface(volume, origin_W + direction_W[ray] * z[:, None])
        depth[ray[hit]], normal[ray[hit]], rgb[ray[hit]] = z[hit], values[0], values[1]
    return RaycastOutput(depth_m=depth.view(H, W), normal_W=normal.view(H, W, 3), rgb=rgb.view(H, W, 3))


def _depth_range(volume: TsdfVolume, camera: Camera, T_WC: Tensor) -> tuple[Tensor, Tensor]:
    """Depths between which each pixel's ray can meet a block: block bounds splatted over tiles of 16 x 16 pixels."""
    T_CW = se3.inverse(T_WC.double())
    side = volume.block_size_m
    corners = (volume.block_coords[:, None].double() + _unit_corners(volume.device)) * side
    xyz_C = se3.apply(T_CW, corners).to(torch.float32)
    z = xyz_C[..., 2]
    z_low, z_high = z.amin(1), z.amax(1)
    # A block that reaches behind the camera is taken to cover the whole picture.
    behind = z_low <= 0.01
    safe = z.clamp_min(0.01)
    nx, ny = -(-camera.width // TILE_PX), -(-camera.height // TILE_PX)
    u = (camera.fx * xyz_C[..., 0] / safe + camera.cx) / TILE_PX
    v = (camera.fy * xyz_C[..., 1] / safe + camera.cy) / TILE_PX
    u0, v0 = (t.amin(1).floor().masked_fill(behind, 0) for t in (u, v))
    u1, v1 = (t.amax(1).floor().masked_fill(behind, n) for t, n in ((u, nx), (v, ny)))
    seen = ((z_high > 0) & (u1 >= 0) & (v1 >= 0) & (u0 < nx) & (v0 < ny)).nonzero()[:, 0]
    u0, u1 = (t[seen].clamp(0, nx - 1).to(torch.int64) for t in (u0, u1))
    v0, v1 = (t[seen].clamp(0, ny - 1).to(torch.int64) for t in (v0, v1))
    wide = u1 - u0 + 1
    n = wide * (v1 - v0 + 1)
    block = torch.arange(seen.shape[0], device=n.device).repeat_interleave(n)
    nth = torch.arange(block.shape[0], device=n.device) - (n.cumsum(0) - n)[block]
    tile = (v0[block] + nth // wide[block]) * nx + u0[block] + nth % wide[block]
    first = torch.full((nx * ny,), float("inf"), device=n.device)
    first.scatter_reduce_(0, tile, z_low[seen][block].clamp_min(0.0), "amin")
    last = torch.zeros(nx * ny, device=n.device).scatter_reduce_(0, tile, z_high[seen][block], "amax")
    return tuple(  # pyright: ignore[reportReturnType]
        t.view(ny, nx).repeat_interleave(TILE_PX, 0).repeat_interleave(TILE_PX, 1)[: camera.height, : camera.width]
        .contiguous() for t in (first, last)
    )  # fmt: skip


def _unit_corners(device: torch.device) -> Float[Tensor, "8 3"]:
    return torch.tensor([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)], dtype=torch.float64, device=device)


def _march(
    volume: TsdfVolume, origin_W: Tensor, direction_W: Tensor, z_first: Tensor, z_last: Tensor
) -> tuple[Int[Tensor, " N"], Float[Tensor, " N"]]:
    """Rays that meet a surface, and the depth of the crossing."""
    voxel, truncation = volume.config.voxel_size_m, volume.config.truncation_m
    ray = (z_first < z_last).nonzero()[:, 0]
    z, z_end, direction = z_first[ray], z_last[ray], direction_W[ray]
    z_per_m = 1.0 / direction.norm(dim=1)
    z_before, D_before = z.clone(), torch.ones_like(z)
    state = torch.full_like(ray, _HIDDEN)
    hits: list[tuple[Tensor, ...]] = []
    while ray.shape[0]:
        point = origin_W + direction * z[:, None]
        D, observed, allocated = _probe(volume, point)
        now = torch.where(observed, torch.where(D < 0, _INSIDE, _FREE), _HIDDEN)
        crossing = (now == _INSIDE) & (state == _FREE)
        if bool(crossing.any()):
            hits.append((ray[crossing], *(t[crossing] for t in (z_before, z, D_before, D))))
        step = torch.where(observed, (STEP * truncation * D.abs()).clamp_min(voxel), voxel) * z_per_m
        outside = (~allocated).nonzero()[:, 0]
        step[outside] = _to_block_exit(volume, point.index_select(0, outside), direction.index_select(0, outside))
        on = ~crossing & ~((now == _FREE) & (state == _INSIDE)) & (z + step < z_end)
        keep = on.nonzero()[:, 0]
        z_before, D_before, state, step = (t.index_select(0, keep) for t in (z, D, now, step))
        ray, z_end, direction, z_per_m = (t.index_select(0, keep) for t in (ray, z_end, direction, z_per_m))
        z = z_before + step
    if not hits:
        return ray, z
    ray, *bracket = (torch.cat(column) for column in zip(*hits, strict=True))
    return ray, _refine(volume, origin_W, direction_W[ray], bracket)


def _probe(volume: TsdfVolume, point_W: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """D (of the voxel that holds the point; interpolated near a surface), whether observed, whether allocated."""
    flat = volume.find_voxels(volume.voxel_index(point_W))
    at = flat.clamp_min(0)
    allocated = flat >= 0
    D = volume.D.view(-1).index_select(0, at)
    observed = allocated & (volume.W.view(-1).index_select(0, at) > 0)
    close = (observed & (D.abs() * volume.config.truncation_m < CLOSE_VOXELS * volume.config.voxel_size_m)).nonzero()
    close = close[:, 0]
    smooth, valid = volume.interpolate(point_W.index_select(0, close))
    D[close] = torch.where(valid, smooth, D[close])
    return D, observed, allocated


def _to_block_exit(volume: TsdfVolume, point_W: Tensor, direction_W: Tensor) -> Tensor:
    """Depth to add to leave the block that holds each point, with a little more to be safely across."""
    side = volume.block_size_m
    p = point_W / side
    ahead = torch.where(direction_W > 0, p.floor() + 1 - p, p - p.floor()) * side
    return (ahead / direction_W.abs().clamp_min(1e-9)).amin(1) + 0.01 * volume.config.voxel_size_m


def _refine(volume: TsdfVolume, origin_W: Tensor, direction_W: Tensor, bracket: list[Tensor]) -> Float[Tensor, " N"]:
    """Depth of the zero of the interpolated D inside a bracket (depths before and after, D before and after).

    Linear interpolation, and once more inside the part of the bracket where the sign changes (regula falsi).
    """
    z0, z1, D0, D1 = bracket
    z = z0 + (z1 - z0) * (D0 / (D0 - D1))
    for _ in range(REFINEMENTS):
        D, valid = volume.interpolate(origin_W + direction_W * z[:, None])
        before, behind = valid & (D >= 0), valid & (D < 0)
        z0, D0 = torch.where(before, z, z0), torch.where(before, D, D0)
        z1, D1 = torch.where(behind, z, z1), torch.where(behind, D, D1)
        z = z0 + (z1 - z0) * (D0 / (D0 - D1))
    return z


def _surface(volume: TsdfVolume, point_W: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Rows of the points whose eight voxels are observed, with their normals and colours, interpolated trilinearly."""
    corners, f = volume.cell_corners(point_W)
    observed = (corners >= 0).all(1) & (volume.W.view(-1)[corners.clamp_min(0)] > 0).all(1)
    hit = observed.nonzero()[:, 0]
    at, f = corners[hit], f[hit]
    D = volume.D.view(-1)[at]
    rgb = (volume.voxel_rgb(at.view(-1)).view(-1, 8, 3) * corner_weights(f)[..., None]).sum(1)
    gradient = []
    for axis in range(3):
        flat = f.clone()
        side = []
        for end in (0.0, 1.0):
            flat[:, axis] = end
            side.append((D * corner_weights(flat)).sum(1))
        gradient.append(side[1] - side[0])
    normal = torch.nn.functional.normalize(torch.stack(gradient, dim=1), dim=1)
    return hit, (normal, rgb)
