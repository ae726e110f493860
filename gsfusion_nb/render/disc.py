"""Disc depth: an opaque Gaussian as a flat disc that the pixel's ray either meets or not, and its gradient written out.

Camera frame: ray r = ((x - cx)/fx, (y - cy)/fy, 1) through the pixel centre; of the Gaussian that it hits, p the centre
and n the axis of the smallest scale, n = R_CW R_q e.

    z = (p . n) / (r . n)    if |r . n| / |r| >= min_cosine  and  z > 0  and  |z - p_z| <= max_offset * largest scale
    z = p_z                  otherwise

    on the plane   dz/dp = n / (r . n),   dz/dn = (p - z r) / (r . n)
    at the centre  dz/dp = (0, 0, 1)

With q = (w, u) of unit length and v_n turned to the world frame, n_W = (w^2 - u.u) e + 2 (u.e) u + 2 w u x e gives

    v_w = 2 v_n . (w e + u x e)
    v_u = 2 ((u . e) v_n + (u . v_n) e - (e . v_n) u + w e x v_n)

and through the normalisation v_q = (v - q (q . v)) / |q|.

Source: Peng et al. 2024 (RTG-SLAM), eq. 4-5. The test of the offset is the released code's, that of z > 0 is ours: a
plane met behind the camera has no depth.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import op
from ..checks import check_mask, check_positive, check_shape
from ..constants import DISC_MAX_OFFSET, DISC_MIN_COSINE
from ..geometry import pixel_grid, quaternion, rays
from ..types import Camera, GaussianParams


@dataclass(frozen=True, kw_only=True, eq=False)
class DiscDepth:
    """Depth and normal of the disc that each pixel hits."""

    depth_m: Float[Tensor, "H W"]
    """z-depth, metres; 0 where no disc is hit."""
    normal_W: Float[Tensor, "H W 3"]
    """Unit normal of the disc, world frame, on the side of the camera; 0 where no disc is hit. No gradient."""
    on_plane: Bool[Tensor, "H W"]
    """The depth is the intersection's, not the centre's."""


@op("disc_depth")
def disc_depth(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    hit_index: Int[Tensor, "H W"],
    *,
    max_offset: float | None = DISC_MAX_OFFSET,
    min_cosine: float = DISC_MIN_COSINE,
) -> DiscDepth:
    """Depth of the disc that each pixel hits (equations at the top of this file).

    Args:
        params, camera, T_WC: as given to ``render_forward``.
        hit_index: Row of the hit Gaussian or -1, ``RenderOutput.hit_index``. [H, W]
        max_offset: Largest |z - p_z|, in largest scales of the disc. ``None``: no such test, as in the paper.
        min_cosine: Least cosine of the angle between ray and normal.

    Raises:
        ValueError: ``hit_index`` is not of the camera's size or names a row that ``params`` does not have.

    Differentiable: ``disc_depth_vjp``.
    """
    check_discs(len(params), camera, hit_index, max_offset, min_cosine)
    s = _meet(params, camera, T_WC, hit_index, max_offset, min_cosine)
    H, W = hit_index.shape
    depth = params.xyz_W.new_zeros(H * W).index_put((s.pixel,), s.z)
    normal = params.xyz_W.new_zeros(H * W, 3)
    away = ((s.p * s.n).sum(-1) > 0).unsqueeze(-1)
    normal[s.pixel] = torch.where(away, -s.n, s.n).detach() @ T_WC[:3, :3].to(s.n).T
    on_plane = torch.zeros_like(hit_index, dtype=torch.bool).flatten().index_put((s.pixel,), s.on_plane)
    return DiscDepth(depth_m=depth.view(H, W), normal_W=normal.view(H, W, 3), on_plane=on_plane.view(H, W))


@op("disc_depth")
def disc_depth_vjp(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    hit_index: Int[Tensor, "H W"],
    v_depth_m: Float[Tensor, "H W"],
    *,
    max_offset: float | None = DISC_MAX_OFFSET,
    min_cosine: float = DISC_MIN_COSINE,
    rows: Bool[Tensor, " N"] | None = None,
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"]]:
    """Gradient of ``disc_depth`` to centre and quaternion (equations at the top of this file).

    Which disc is hit, and which of the two cases applies, is taken as given: nothing flows to scale or opacity.

    Args:
        params, camera, T_WC, hit_index, max_offset, min_cosine: as given to ``disc_depth``.
        v_depth_m: dL/d of its depth.
        rows: Gradients are wanted only where this is true; the others cost nothing. [N]

    Returns:
        ``(v_xyz_W, v_quat)``, zero for a Gaussian that no pixel hits or that is frozen.
    """
    check_discs(len(params), camera, hit_index, max_offset, min_cosine)
    if rows is not None:
        check_mask("rows", rows, (len(params),))
        trained = torch.cat([rows, rows.new_zeros(1)])  # -1, no hit, names the last
        hit_index = torch.where(trained[hit_index], hit_index, -1)
    with torch.no_grad():
        s = _meet(params, camera, T_WC, hit_index, max_offset, min_cosine)
        v = v_depth_m.to(s.z).flatten()[s.pixel]
        v_plane = torch.where(s.on_plane, v / s.rn, 0.0)[:, None]
        v_p = v_plane * s.n
        v_p[:, 2] += torch.where(s.on_plane, 0.0, v)
        v_n = v_plane * (s.p - s.z[:, None] * s.r)
        v_p_W, v_n_W = s.z.new_zeros(len(params), 6).index_add_(0, s.row, torch.cat([v_p, v_n], dim=1)).split(3, dim=1)
        R_WC = T_WC[:3, :3].to(s.z)
        return v_p_W @ R_WC.T, _axis_vjp(params, v_n_W @ R_WC.T)


def check_discs(count: int, camera: Camera, hit_index: Tensor, max_offset: float | None, min_cosine: float) -> None:
    """Raise ``ValueError`` unless the arguments of ``disc_depth`` fit together."""
    check_shape("hit_index", hit_index, (camera.height, camera.width))
    if int(hit_index.max()) >= count:
        raise ValueError(f"hit_index must name rows of the {count} Gaussians, got {int(hit_index.max())}")
    check_positive("min_cosine", min_cosine)
    if max_offset is not None:
        check_positive("max_offset", max_offset)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Meeting:
    """The M pixels that hit a disc, camera frame."""

    pixel: Tensor  # [M] place in the flat image
    row: Tensor  # [M]
    r: Tensor  # [M, 3]
    p: Tensor  # [M, 3]
    n: Tensor  # [M, 3]
    rn: Tensor  # [M] r . n, and 1 where it is too small
    z: Tensor  # [M]
    on_plane: Tensor  # [M]


def _meet(
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    hit_index: Tensor,
    max_offset: float | None,
    min_cosine: float,
) -> _Meeting:
    T_WC = T_WC.to(params.xyz_W)
    pixel = (hit_index.flatten() >= 0).nonzero().squeeze(1)
    row = hit_index.flatten()[pixel].long()
    r = rays(camera, pixel_grid(camera, device=T_WC.device, dtype=T_WC.dtype)).view(-1, 3)[pixel]
    p = ((params.xyz_W - T_WC[:3, 3]) @ T_WC[:3, :3]).index_select(0, row)
    columns = quaternion.to_matrix(params.quat).transpose(1, 2)
    n_W = columns[torch.arange(len(params), device=row.device), params.log_scale.argmin(1)]
    n = (n_W @ T_WC[:3, :3]).index_select(0, row)

    rn = (r * n).sum(-1)
    on_plane = rn.abs() >= min_cosine * r.norm(dim=-1)
    rn = torch.where(on_plane, rn, 1.0)
    z = (p * n).sum(-1) / rn
    on_plane = on_plane & (z > 0)
    if max_offset is not None:
        reach = max_offset * params.log_scale.amax(1).exp()
        on_plane = on_plane & ((z - p[:, 2]).abs() <= reach.index_select(0, row))
    return _Meeting(pixel=pixel, row=row, r=r, p=p, n=n, rn=rn, z=torch.where(on_plane, z, p[:, 2]), on_plane=on_plane)


def _axis_vjp(params: GaussianParams, v_n: Tensor) -> Tensor:
    """Gradient of the axis of the smallest scale to the quaternion. [N, 4]"""
    norm = params.quat.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    q = params.quat / norm
    w, u = q.split([1, 3], dim=1)
    e = torch.nn.functional.one_hot(params.log_scale.argmin(1), 3).to(q)
    ue, uv, ev = ((a * b).sum(-1, keepdim=True) for a, b in ((u, e), (u, v_n), (e, v_n)))
    v_w = 2 * (v_n * (w * e + torch.linalg.cross(u, e))).sum(-1, keepdim=True)
    v_u = 2 * (ue * v_n + uv * e - ev * u + w * torch.linalg.cross(e, v_n))
    v = torch.cat([v_w, v_u], dim=1)
    return (v - q * (q * v).sum(-1, keepdim=True)) / norm
