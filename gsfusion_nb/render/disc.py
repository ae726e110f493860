"""Disc depth: an opaque Gaussian as a flat disc that the ray of a pixel meets, and its gradient.

In the camera frame, for the ray r = K^-1 (u, v, 1) and the Gaussian that it hits, with p the centre
and n = R_CW R_q e the axis of the smallest scale:

    z = (p . n) / (r . n)    if  |r . n| / |r| >= min_cosine
                             and z > 0
                             and |z - p_z| <= max_offset * largest scale
    z = p_z                  otherwise

    on the plane   dz/dp = n / (r . n),   dz/dn = (p - z r) / (r . n)
    at the centre  dz/dp = (0, 0, 1)

Source: RTG-SLAM (Peng et al. 2024), Eq. 4-5. The test of the offset is that of the released code.
The test of z > 0 is ours: a plane that is met behind the camera has no depth.

``view_surface`` is the surface that a camera sees in a map: mappers compare it with depth, trackers
align frames with it.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import op, piece
from ..checks import check_positive
from ..config import DiscConfig
from ..errors import ArgumentError
from ..geometry import pixel_grid, quaternion, rays, se3
from ..geometry.operands import INTEGERS, check_gaussians, check_operand, check_view
from ..types import Camera, GaussianParams
from .constants import DISC_MAX_OFFSET, DISC_MIN_COSINE, OPAQUE_ALPHA
from .rasterize import check_rows

PUBLISHED_DISCS = DiscConfig(
    opaque_alpha=OPAQUE_ALPHA, min_cosine=DISC_MIN_COSINE, max_offset=DISC_MAX_OFFSET
)
"""When a disc counts as hit as published, for maps of systems that have no such settings."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DiscDepth:
    """Depth and normal of the disc that each pixel hits."""

    depth_m: Float[Tensor, "H W"]
    """z-depth, metres; 0 where no disc is hit."""
    normal_W: Float[Tensor, "H W 3"]
    """Unit normal of the disc, world frame, on the side of the camera; 0 where no disc is hit. No
    gradient."""
    on_plane: Bool[Tensor, "H W"]
    """Whether the depth is that of the intersection with the plane, not of the centre."""


def check_discs(
    params: Any,
    camera: Any,
    T_WC: Any,
    hit_index: Any,
    *,
    max_offset: float | None = DISC_MAX_OFFSET,
    min_cosine: float = DISC_MIN_COSINE,
) -> None:
    """Raise ``ValueError`` for arguments that ``disc_depth`` refuses."""
    check_gaussians(params)
    device = params.xyz_W.device
    check_view(camera, T_WC, device)
    check_operand(
        "hit_index", hit_index, (camera.height, camera.width), dtypes=INTEGERS, device=device
    )
    if device.type == "cpu" and int(hit_index.max()) >= len(params):
        raise ArgumentError(
            f"hit_index must name rows of the {len(params)} Gaussians, got {int(hit_index.max())}; "
            "take the hit_index that render_forward gave for the same map"
        )
    check_positive("min_cosine", min_cosine)
    if max_offset is not None:
        check_positive("max_offset", max_offset)


def check_discs_vjp(
    params: Any,
    camera: Any,
    T_WC: Any,
    hit_index: Any,
    v_depth_m: Any,
    *,
    rows: Any = None,
    **options: float | None,
) -> None:
    """Raise ``ValueError`` for arguments that ``disc_depth_vjp`` refuses."""
    check_discs(params, camera, T_WC, hit_index, **options)  # pyright: ignore[reportArgumentType]
    check_operand("v_depth_m", v_depth_m, (camera.height, camera.width), device=params.xyz_W.device)
    check_rows(params.xyz_W, rows)


@op("disc_depth", check_discs)
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
        max_offset: Largest |z - p_z|, in units of the disc's largest scale. ``None``: no limit, as
            in the paper.
        min_cosine: Smallest cosine of the angle between ray and normal.

    Raises:
        ValueError: ``hit_index`` is not of the camera's size or names a row that ``params`` does
            not have.

    Differentiable: ``disc_depth_vjp``.
    """
    m = _meet(params, camera, T_WC, hit_index, max_offset, min_cosine)
    has_disc = hit_index >= 0
    depth_m = params.xyz_W.new_zeros(has_disc.shape)
    on_plane = torch.zeros_like(has_disc)
    depth_m[has_disc] = m.z
    on_plane[has_disc] = m.on_plane
    with torch.no_grad():
        normal_W = params.xyz_W.new_zeros(*has_disc.shape, 3)
        faces_away = (m.p * m.n).sum(-1, keepdim=True) > 0
        normal_W[has_disc] = torch.where(faces_away, -m.n, m.n) @ m.R_WC.T
    return DiscDepth(depth_m=depth_m, normal_W=normal_W, on_plane=on_plane)


@op("disc_depth", check_discs_vjp)
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
    """Gradient of ``disc_depth`` with respect to centre and quaternion (equations at the top of
    this file).

    Which disc is hit, and which of the two cases applies, is treated as constant: scale and opacity
    get no gradient.

    Args:
        params, camera, T_WC, hit_index, max_offset, min_cosine: as given to ``disc_depth``.
        v_depth_m: dL/d of its depth.
        rows: Compute gradients only where this is true; the other Gaussians are frozen. [N]

    Returns:
        ``(v_xyz_W, v_quat)``, zero for a Gaussian that no pixel hits or that is frozen.
    """
    with torch.no_grad():
        m = _meet(params, camera, T_WC, hit_index, max_offset, min_cosine)
        v_z = v_depth_m.to(m.z)[hit_index >= 0, None]
        on_plane = m.on_plane[:, None]
        # on the plane z = (p . n) / (r . n), else z = p_z
        v_p = torch.where(
            on_plane,
            v_z * m.n / m.rn,
            v_z * m.n.new_tensor([0.0, 0.0, 1.0]),
        )
        v_n = torch.where(
            on_plane,
            v_z * (m.p - m.z[:, None] * m.r) / m.rn,
            0.0,
        )
        # p = R_CW (x_W - t),  n = R_CW R_q e: every pixel adds to the Gaussian that it hits
        v_xyz_W, v_n_W = (
            v.new_zeros(len(params), 3).index_add(0, m.row, v @ m.R_WC.T) for v in (v_p, v_n)
        )
        v_quat = quaternion.to_matrix_vjp(
            params.quat,
            v_n_W[:, :, None] * m.e[:, None, :],
        )
    if rows is not None:
        v_xyz_W, v_quat = (torch.where(rows[:, None], v, 0.0) for v in (v_xyz_W, v_quat))
    return v_xyz_W, v_quat


@piece
def disc_hit(
    r: Float[Tensor, "M 3"],
    p: Float[Tensor, "M 3"],
    n: Float[Tensor, "M 3"],
    min_cosine: float,
) -> Float[Tensor, " M"]:
    """z-depth at which rays meet the planes of discs, or that of the disc's centre where a ray is
    too flat.

    Args:
        r: Rays with r_z = 1, camera frame. [M, 3]
        p, n: Centre, metres, and unit normal of the disc of each ray, camera frame. [M, 3]
        min_cosine: Smallest cosine of the angle between ray and normal.

    Source: Peng et al. 2024, Eq. 4-5.
    """
    steep = _is_steep(r, n, min_cosine)
    rn = torch.where(steep, (r * n).sum(-1), 1.0)
    theta = (p * n).sum(-1) / rn  # RTG-SLAM Eq. 4; the point theta r has depth theta, for r_z = 1
    return torch.where(steep, theta, p[:, 2])  # RTG-SLAM Eq. 5


def _is_steep(
    r: Float[Tensor, "M 3"], n: Float[Tensor, "M 3"], min_cosine: float
) -> Bool[Tensor, " M"]:
    """Whether the angle between ray and normal is small enough for the plane to be used (the
    condition of Eq. 5)."""
    return (r * n).sum(-1).abs() >= min_cosine * r.norm(dim=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Meeting:
    """The M pixels that hit a disc, in the camera frame, where the R_g of RTG-SLAM is the identity
    and t_g is zero."""

    R_WC: Float[Tensor, "3 3"]
    e: Float[Tensor, "N 3"]
    """Axis of the smallest scale, in the frame of each Gaussian."""
    row: Int[Tensor, " M"]
    """The Gaussian that each pixel hits."""
    r: Float[Tensor, "M 3"]
    """K^-1 u: ray with r_z = 1."""
    p: Float[Tensor, "M 3"]
    n: Float[Tensor, "M 3"]
    rn: Float[Tensor, "M 1"]
    """r . n; 1 where it is too small to divide by."""
    z: Float[Tensor, " M"]
    on_plane: Bool[Tensor, " M"]


def _meet(
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    hit_index: Tensor,
    max_offset: float | None,
    min_cosine: float,
) -> _Meeting:
    T_WC = T_WC.to(params.xyz_W)
    T_CW = se3.inverse(T_WC)
    row = hit_index[hit_index >= 0].long()
    e = torch.nn.functional.one_hot(params.log_scale.argmin(dim=1), 3).to(params.xyz_W)
    n_W = (quaternion.to_matrix(params.quat) @ e[:, :, None]).squeeze(-1)
    r = rays(camera, pixel_grid(camera, device=row.device, dtype=T_WC.dtype))[hit_index >= 0]
    p = se3.apply(T_CW, params.xyz_W)[row]
    n = se3.rotate(T_CW, n_W)[row]

    z = disc_hit(r, p, n, min_cosine)
    on_plane = _is_steep(r, n, min_cosine)
    rn = torch.where(on_plane, (r * n).sum(-1), 1.0)
    on_plane = on_plane & (z > 0)
    if max_offset is not None:
        largest_scale = params.log_scale.amax(dim=1).exp()
        on_plane = on_plane & ((z - p[:, 2]).abs() <= max_offset * largest_scale[row])
    z = torch.where(on_plane, z, p[:, 2])
    return _Meeting(
        R_WC=T_WC[:3, :3],
        e=e,
        row=row,
        r=r,
        p=p,
        n=n,
        rn=rn[:, None],
        z=z,
        on_plane=on_plane,
    )
