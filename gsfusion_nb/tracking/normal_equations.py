"""Projective association, the point-to-plane residual with its Jacobian, and their sum over a frame (Eq. 10)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..backends import op
from ..geometry import depth_to_points, pixel_grid, project, rays, se3
from .pyramid import DepthLevel
from .surface import Surface


@dataclass(frozen=True, kw_only=True, eq=False)
class IcpSystem:
    """Normal equations of  sum w (r + J xi)^2  over the correspondences, float64."""

    H: Float[Tensor, "6 6"]
    """sum w J^T J, translation first."""
    b: Float[Tensor, " 6"]
    """sum w J^T r, half the gradient of the sum of squares."""
    sum_squares_m2: float
    """sum w r^2."""
    sum_weights: float
    """sum w."""
    n_inliers: int
    """Correspondences that passed the gates."""
    n_overlap: int
    """Pixels of the frame that fall on known pixels of the surface; the others say nothing about the pose."""

    @property
    def rms_m(self) -> float:
        """Weighted root mean square point-to-plane distance of the correspondences, metres; infinite without any."""
        return (self.sum_squares_m2 / self.sum_weights) ** 0.5 if self.sum_weights > 0 else float("inf")


@dataclass(frozen=True, kw_only=True, eq=False)
class Correspondences:
    """Each pixel of the frame beside the point of the surface at the pixel that it falls on.

    Points are relative to the surface's camera centre, along the axes of the world: there, rotations turn the view
    about the camera, however far the world's origin is.
    """

    xyz: Float[Tensor, "H W 3"]
    """Point of the frame, metres."""
    surface_xyz: Float[Tensor, "H W 3"]
    """Point of the surface, metres."""
    surface_normal: Float[Tensor, "H W 3"]
    overlap: Bool[Tensor, "H W"]
    """Both have depth."""
    inlier: Bool[Tensor, "H W"]
    """Both also agree within the gates."""


def point_to_plane(
    xyz: Float[Tensor, "N 3"], surface_xyz: Float[Tensor, "N 3"], surface_normal: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, " N"], Float[Tensor, "N 6"]]:
    """Residual  r = n . (p - q)  and its derivative by a twist xi (translation first) with  p <- exp(xi) p.

    dp = rho + omega x p, so  dr/dxi = [n, p x n].

    Returns:
        r, metres, and J.

    Differentiable: yes, through torch. Source: Peng et al. 2024, Eq. 10; Chen & Medioni 1992.
    """
    r = ((xyz - surface_xyz) * surface_normal).sum(-1)
    J = torch.cat([surface_normal, torch.linalg.cross(xyz, surface_normal)], dim=-1)
    return r, J


def associate(
    level: DepthLevel, T_WC: Float[Tensor, "4 4"], surface: Surface, *, max_distance_m: float, min_cosine: float
) -> Correspondences:
    """Projective association: every point of the frame is compared with the surface at the pixel it projects into.

    Args:
        level: The frame.
        T_WC: Its supposed pose.
        surface: Where to look.
        max_distance_m: Points farther apart do not correspond.
        min_cosine: Nor do points whose normals are at an angle with a smaller cosine.

    Differentiable: no. Source: Blais & Levine 1995; Newcombe et al. 2011.
    """
    dtype = level.depth_m.dtype
    centre = surface.T_WC[:3, 3].double()
    T = T_WC.double().clone()
    T[:3, 3] -= centre
    T = T.to(dtype)
    R_WS = surface.T_WC.to(dtype)[:3, :3]
    xyz = se3.apply(T, depth_to_points(level.camera, level.depth_m))
    in_surface = xyz @ R_WS
    uv = project(surface.camera, in_surface)
    H, W = surface.camera.height, surface.camera.width
    u, v = uv[..., 0], uv[..., 1]
    inside = (level.depth_m > 0) & (in_surface[..., 2] > 0) & (u >= 0) & (u < W) & (v >= 0) & (v < H)
    at = torch.where(inside, v, 0.0).long() * W + torch.where(inside, u, 0.0).long()
    depth = surface.depth_m.to(dtype).reshape(-1)[at]
    normal = surface.normal_W.to(dtype).reshape(-1, 3)[at]
    ray = rays(surface.camera, pixel_grid(surface.camera, device=depth.device, dtype=dtype)).view(-1, 3)[at]
    surface_xyz = (ray * depth[..., None]) @ R_WS.T
    overlap = inside & (depth > 0) & (normal != 0).any(-1)
    near = (xyz - surface_xyz).square().sum(-1) <= max_distance_m**2
    aligned = (se3.rotate(T, level.normal_C) * normal).sum(-1) >= min_cosine
    return Correspondences(
        xyz=xyz, surface_xyz=surface_xyz, surface_normal=normal, overlap=overlap, inlier=overlap & near & aligned
    )


def depth_weight(depth_m: Float[Tensor, "*N"], even_to_m: float | None) -> Float[Tensor, "*N"]:
    """How much a measurement at a depth counts: min(1, (even_to / z)^4), or 1 without a limit.

    The deviation of a structured-light camera grows with z^2 (Khoshelham & Elberink 2012); its calibration errs in the
    same way. Eq. 10 has no weights.
    """
    if even_to_m is None:
        return torch.ones_like(depth_m)
    return (even_to_m / depth_m.clamp_min(1e-6)).clamp(max=1.0).square().square()


@op("icp")
def icp_system(
    level: DepthLevel,
    T_WC: Float[Tensor, "4 4"],
    surface: Surface,
    *,
    max_distance_m: float,
    min_cosine: float,
    even_to_m: float | None = None,
) -> IcpSystem:
    """Normal equations of the point-to-plane error about the pose ``T_WC``.

    The twist turns and moves the frame in the world's axes about the centre o of the surface's camera:
    ``T_WC <- shift(o) exp(xi) shift(-o) T_WC``.

    Args:
        level, T_WC, surface, max_distance_m, min_cosine: See ``associate``.
        even_to_m: See ``depth_weight``.

    Differentiable: no. Source: Peng et al. 2024, Eq. 10.
    """
    found = associate(level, T_WC, surface, max_distance_m=max_distance_m, min_cosine=min_cosine)
    rows = found.inlier
    r, J = point_to_plane(found.xyz[rows], found.surface_xyz[rows], found.surface_normal[rows])
    r, J, w = r.double(), J.double(), depth_weight(level.depth_m[rows], even_to_m).double()
    return IcpSystem(
        H=(J * w[:, None]).T @ J,
        b=J.T @ (w * r),
        sum_squares_m2=float((w * r) @ r),
        sum_weights=float(w.sum()),
        n_inliers=int(rows.sum()),
        n_overlap=int(found.overlap.sum()),
    )
