"""The normal equations of point-to-plane ICP: pairs of a frame and a surface, and sums over them
(Peng et al. 2024, Eq. 10).
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..backends import op, piece
from ..checks import check_number, check_positive
from ..errors import ArgumentError
from ..geometry import depth_to_points, project, se3
from ..geometry.operands import check_operand, check_view
from .surface import DepthLevel, Surface, about_the_surface


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
    """Number of correspondences within the limits of distance and angle."""
    n_overlap: int
    """Number of pixels of the frame that fall on known pixels of the surface, which alone give
    information."""

    @property
    def rms_m(self) -> float:
        """Weighted root mean square point-to-plane distance of the correspondences, metres;
        infinite without any."""
        return (
            (self.sum_squares_m2 / self.sum_weights) ** 0.5
            if self.sum_weights > 0
            else float("inf")
        )

    def plus(
        self,
        H: Float[Tensor, "6 6"],
        b: Float[Tensor, " 6"],
    ) -> "IcpSystem":
        """The system with the sums of further rows; distances and counts stay those of depth."""
        both_H = self.H.cpu() + H.cpu()
        both_b = self.b.cpu() + b.cpu()
        return dataclasses.replace(self, H=both_H, b=both_b)


@dataclass(frozen=True, kw_only=True, eq=False)
class Correspondences:
    """The point of each pixel of the frame, and the point of the surface at the pixel that it
    projects to.

    Points are relative to the centre of the surface's camera, along the axes of the world, so that
    rotations are about that camera and not about a world origin that may be far away.
    """

    xyz: Float[Tensor, "H W 3"]
    """Point of the frame, metres."""
    surface_xyz: Float[Tensor, "H W 3"]
    """Point of the surface, metres."""
    surface_normal: Float[Tensor, "H W 3"]
    overlap: Bool[Tensor, "H W"]
    """Whether both have depth."""
    inlier: Bool[Tensor, "H W"]
    """Whether both also agree within the limits of distance and angle."""


@piece
def point_to_plane(
    xyz: Float[Tensor, "N 3"],
    surface_xyz: Float[Tensor, "N 3"],
    surface_normal: Float[Tensor, "N 3"],
) -> tuple[Float[Tensor, " N"], Float[Tensor, "N 6"]]:
    """Residual  r = n . (p - q)  and its derivative with respect to a twist xi (translation first),
    p <- exp(xi) p.

    dp = rho + omega x p, so  dr/dxi = [n, p x n].

    Returns:
        r, metres [N], and J [N, 6].

    Differentiable: yes, through torch. Source: Peng et al. 2024, Eq. 10; Chen & Medioni 1992.
    """
    r = ((xyz - surface_xyz) * surface_normal).sum(-1)  # RTG-SLAM Eq. 10
    J = torch.cat([surface_normal, torch.linalg.cross(xyz, surface_normal)], dim=-1)
    return r, J


def associate(
    level: DepthLevel,
    T_WC: Float[Tensor, "4 4"],
    surface: Surface,
    *,
    max_distance_m: float,
    min_cosine: float,
) -> Correspondences:
    """Projective association: every point of the frame is compared with the surface at the pixel it
    projects into.

    Args:
        level: A pyramid level of the frame.
        T_WC: Estimate of its camera-to-world pose. [4, 4]
        surface: The surface.
        max_distance_m: Largest distance of corresponding points, metres.
        min_cosine: Smallest cosine of the angle between the normals of corresponding points.

    Differentiable: no. Source: Blais & Levine 1995; Newcombe et al. 2011.
    """
    dtype = level.depth_m.dtype
    T, R_WS = about_the_surface(T_WC, surface.T_WC, dtype)
    xyz = se3.apply(T, depth_to_points(level.camera, level.depth_m))
    xyz_S = xyz @ R_WS
    u, v = project(surface.camera, xyz_S).unbind(-1)
    H = surface.camera.height
    W = surface.camera.width
    is_ahead = (level.depth_m > 0) & (xyz_S[..., 2] > 0)
    in_width = (u >= 0) & (u < W)
    in_height = (v >= 0) & (v < H)
    in_image = is_ahead & in_width & in_height
    row = v.where(in_image, 0.0).long()
    column = u.where(in_image, 0.0).long()

    surface_xyz_S = depth_to_points(surface.camera, surface.depth_m.to(dtype))[row, column]
    surface_xyz = surface_xyz_S @ R_WS.T
    surface_normal = surface.normal_W.to(dtype)[row, column]
    overlap = in_image & (surface_xyz_S[..., 2] > 0) & (surface_normal != 0).any(-1)
    is_near = (xyz - surface_xyz).square().sum(-1) <= max_distance_m**2
    is_aligned = (se3.rotate(T, level.normal_C) * surface_normal).sum(-1) >= min_cosine
    inlier = overlap & is_near & is_aligned
    return Correspondences(
        xyz=xyz,
        surface_xyz=surface_xyz,
        surface_normal=surface_normal,
        overlap=overlap,
        inlier=inlier,
    )


def depth_weight(
    depth_m: Float[Tensor, "*N"],
    even_to_m: float | None,
) -> Float[Tensor, "*N"]:
    """Weight of a measurement at depth z: min(1, (even_to / z)^4), or 1 without a limit.

    The standard deviation of a structured-light camera grows with z^2 (Khoshelham & Elberink 2012),
    and so does its calibration error. Eq. 10 has no weights.
    """
    if even_to_m is None:
        return torch.ones_like(depth_m)
    return ((even_to_m / depth_m.clamp_min(1e-6)) ** 4).clamp(max=1.0)


def check_icp(
    level: Any,
    T_WC: Any,
    surface: Any,
    *,
    max_distance_m: float,
    min_cosine: float,
    even_to_m: float | None = None,
) -> None:
    """Raise ``ValueError`` for arguments that ``icp_system`` refuses."""
    for name, kind, value in (("level", DepthLevel, level), ("surface", Surface, surface)):
        if not isinstance(value, kind):
            raise ArgumentError(f"{name} must be a {kind.__name__}, got {type(value).__name__}")
    check_operand("depth_m", level.depth_m, (level.camera.height, level.camera.width))
    device = level.depth_m.device
    check_view(level.camera, T_WC, device)
    images = {"normal_C": level.normal_C}
    surface_images = {
        "depth_m of the surface": surface.depth_m,
        "normal_W of the surface": surface.normal_W,
    }
    for camera, both in ((level.camera, images), (surface.camera, surface_images)):
        for name, image in both.items():
            channels = (3,) if "normal" in name else ()
            check_operand(name, image, (camera.height, camera.width, *channels), device=device)
    check_view(surface.camera, surface.T_WC, device)
    check_positive("max_distance_m", max_distance_m)
    check_number("min_cosine", min_cosine)
    if even_to_m is not None:
        check_positive("even_to_m", even_to_m)


@op("icp", check_icp)
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

    The twist rotates and moves the frame in the world's axes about the centre o of the surface's
    camera: ``T_WC <- shift(o) exp(xi) shift(-o) T_WC``.

    Args:
        level, T_WC, surface, max_distance_m, min_cosine: See ``associate``.
        even_to_m: See ``depth_weight``.

    Differentiable: no. Source: Peng et al. 2024, Eq. 10.
    """
    pairs = associate(level, T_WC, surface, max_distance_m=max_distance_m, min_cosine=min_cosine)
    rows = pairs.inlier
    r, J = point_to_plane(
        pairs.xyz[rows],
        pairs.surface_xyz[rows],
        pairs.surface_normal[rows],
    )
    r = r.double()
    J = J.double()
    w = depth_weight(level.depth_m[rows], even_to_m).double()
    return IcpSystem(
        H=J.T @ (w[:, None] * J),
        b=J.T @ (w * r),
        sum_squares_m2=float((w * r**2).sum()),
        sum_weights=float(w.sum()),
        n_inliers=int(rows.sum()),
        n_overlap=int(pairs.overlap.sum()),
    )
