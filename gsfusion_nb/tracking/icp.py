"""Frame-to-model ICP: the pose at which a depth frame fits a surface best (Peng et al. 2024, Eq.
10).

One iteration: every point p of the frame gets a partner q with normal n on the surface
(``associate``). The sums H = J^T J and b = J^T r of  r = n . (p - q)  are taken (``icp_system``).
The step  xi = -H^-1 b  moves the pose, T <- exp(xi) T  (``solve_step``, ``next_pose``).

All twists are in the axes of the world, translation first, and turn about the centre o of the
surface's camera: a turn about an origin far away would be mixed with a large translation.
``recentred`` writes a twist about another point: the rows of landmarks come about the world's
origin, and a step is solved about the mean of the points.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..backends import op, piece
from ..checks import check_number, check_positive
from ..config import TrackingConfig
from ..errors import ArgumentError
from ..geometry import depth_to_points, project, se3, sum_rows
from ..geometry.operands import check_operand, check_view
from ..types import Camera
from .brightness import Pictures
from .surface import DepthLevel, Surface, about_the_surface, depth_pyramid


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Extent:
    """Mean and spread of the points of a frame: in a twist about the mean, with rotations times the
    spread, all six components are metres of surface motion (Gelfand et al. 2003)."""

    centre: Float[Tensor, " 3"]
    """Mean of the points, in the frame of the twist, metres; float64."""
    spread_m: float
    """Root mean square distance from the mean, metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Step:
    """A solution of the normal equations."""

    xi: Float[Tensor, " 6"]
    """Twist, translation first, float64."""
    length_m: float
    """How far it moves the surface, metres: its norm in the units of ``Extent``."""
    eigenvalues: Float[Tensor, " 6"]
    """Mean information of the six principal directions of motion, smallest first; their sum is
    about 2."""
    degenerate: int
    """Number of these directions that the scene does not determine."""


def recentred(offset: Float[Tensor, " 3"]) -> Float[Tensor, "6 6"]:
    """A of  xi_a = A xi_b: the twist about a of the motion that is xi_b about b = a + ``offset``.

    Both move a point p alike,  rho_a + omega x (p - a) = rho_b + omega x (p - b),  so  rho_a =
    rho_b + (b - a) x omega.
    """
    A = torch.eye(6, dtype=torch.float64)
    A[:3, 3:] = se3.hat(offset.double().cpu())
    return A


def solve_step(system: IcpSystem, extent: Extent, *, damping: float, min_eigenvalue: float) -> Step:
    """Minimise  |r + J xi|^2 + damping tr(H) |xi|^2  in the directions of motion that the scene
    determines.

    The twist is first written about the mean of the points, xi = A y, so that the eigenvalues of
    A^T H A can be compared. In directions whose eigenvalue is below ``min_eigenvalue`` times the
    largest, the step is 0: there the pose keeps its starting value, the prediction (solution
    remapping).

    Args:
        system: Normal equations H, b.
        extent: Mean and spread of the points.
        damping: Share of the trace that is added to every eigenvalue.
        min_eigenvalue: Smallest eigenvalue of a determined direction, as a share of the largest.

    Differentiable: no. Source: Zhang, Kaess & Singh 2016, "On degeneracy of optimization-based
    state estimation".
    """
    A = recentred(extent.centre)
    A[:, 3:] /= extent.spread_m
    weight = max(system.sum_weights, 1e-12)
    H = A.T @ system.H.cpu() @ A / weight
    b = A.T @ system.b.cpu() / weight
    eigenvalues, directions = torch.linalg.eigh(H)
    is_determined = eigenvalues >= max(min_eigenvalue * float(eigenvalues[-1]), 1e-12)
    damped_eigenvalues = eigenvalues + damping * float(eigenvalues.sum())
    y = -directions @ (directions.T @ b).div(damped_eigenvalues).where(is_determined, 0.0)
    return Step(
        xi=A @ y,
        length_m=float(y.norm()),
        eigenvalues=eigenvalues,
        degenerate=int((~is_determined).sum()),
    )


ExtraRows = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Further rows of the least squares, such as landmarks: given a pose ``T_WC`` [4, 4], returns the
sums of w J^T J [6, 6] and w J^T r [6], float64 on the CPU, for a twist in world axes about the
world's origin, ``T_WC <- exp(xi) T_WC`` (translation first). r in metres; weight 1 is that of a
pixel of depth nearer than ``even_to_m``."""

DAMPING = 1e-6
"""Damping of the normal equations, as a share of their trace (released code: 1e-4)."""

LEAST_STEP_M = 1e-5
"""ICP ends on the finest level when a step moves the surface by less than this, metres; on coarser
levels the limit is multiplied by their reduction factor."""


@dataclass(frozen=True, kw_only=True, eq=False)
class IcpIteration:
    """One Gauss-Newton step."""

    factor: int
    """Reduction factor of the pyramid level."""
    T_WC: Float[Tensor, "4 4"]
    """Pose before the step, float64."""
    rms_m: float
    """Root mean square point-to-plane distance at that pose, metres."""
    n_inliers: int
    n_overlap: int
    step_m: float
    """How far the step moved the surface, metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class IcpResult:
    """The result of ICP and its steps. Counts are of the finest level, at the final pose."""

    T_WC: Float[Tensor, "4 4"]
    """Camera-to-world pose, float64."""
    rms_m: float
    """Root mean square point-to-plane distance of the correspondences, metres."""
    n_inliers: int
    """Number of correspondences within the limits of distance and angle."""
    n_overlap: int
    """Number of pixels that fall on a known part of the surface."""
    n_pixels: int
    """Number of pixels with usable depth."""
    eigenvalues: tuple[float, ...]
    """Mean information of the six principal directions of motion, smallest first (see
    ``solve_step``)."""
    degenerate: int
    """Number of these directions that the scene does not determine. Along them the pose keeps its
    starting value."""
    history: tuple[IcpIteration, ...]

    @property
    def inlier_share(self) -> float:
        """Correspondences as a share of the pixels with usable depth."""
        return self.n_inliers / max(self.n_pixels, 1)

    @property
    def overlap_inlier_share(self) -> float:
        """Correspondences as a share of the pixels that fall on a known part of the surface."""
        return self.n_inliers / max(self.n_overlap, 1)


def icp(
    depth_m: Float[Tensor, "H W"],
    camera: Camera,
    surface: Surface,
    T_WC_start: Float[Tensor, "4 4"],
    config: TrackingConfig | None = None,
) -> IcpResult:
    """The pose that minimises the point-to-plane error between a depth frame and a surface.

    Args:
        depth_m: z-depth, metres, 0 where there is none. [H, W]
        camera: Its intrinsics.
        surface: The surface to align it with.
        T_WC_start: Camera-to-world pose to start from. [4, 4]
        config: Pyramid levels, limits of correspondences, damping.

    Returns:
        The pose and how well it fits. The caller decides whether it is good enough: without any
        correspondence the pose is the starting pose and ``n_inliers`` is 0.

    Differentiable: no. Source: Peng et al. 2024, Eq. 10; Newcombe et al. 2011.
    """
    config = config or TrackingConfig()
    return align(depth_pyramid(depth_m, camera, config.pyramid), surface, T_WC_start, config)


def align(
    levels: list[DepthLevel],
    surface: Surface,
    T_WC_start: Float[Tensor, "4 4"],
    config: TrackingConfig,
    extra: ExtraRows | None = None,
    pictures: Pictures | None = None,
) -> IcpResult:
    """``icp`` of a frame whose pyramid was made before. Levels are used in the order given.

    Brightness (``pictures``) and ``extra`` join every step. Distances and counts of the result are
    those of depth alone.
    """
    rows = _Rows(surface, config, extra, pictures)
    o = surface.T_WC[:3, 3].double().cpu()
    T_WC = T_WC_start.double().cpu()
    points = _extent(levels[-1], config.even_to_m)
    history: list[IcpIteration] = []
    for level, iterations in zip(levels, config.iterations, strict=True):
        # 5 degrees move a point 2 m away by 17 cm, more than the limit of the finest level. A limit
        # in proportion to the factor would be too large: with it one frame of a noise-free room
        # converged to a wrong pose.
        reach = (level.factor / levels[-1].factor) ** 0.5
        for _ in range(iterations):
            system, joint_system = rows.at(level, T_WC, reach * config.max_distance_m)
            if system.n_inliers < 6:
                break
            step = _step(joint_system, T_WC, o, points, config)
            fit = {
                "rms_m": system.rms_m,
                "n_inliers": system.n_inliers,
                "n_overlap": system.n_overlap,
            }
            history.append(
                IcpIteration(factor=level.factor, T_WC=T_WC, step_m=step.length_m, **fit)
            )
            T_WC = se3.translate(next_pose(se3.translate(T_WC, -o), joint_system, step), o)
            if step.length_m < LEAST_STEP_M * level.factor:
                break
    system, joint_system = rows.at(levels[-1], T_WC, config.max_distance_m)
    last = _step(joint_system, T_WC, o, points, config)
    return IcpResult(
        T_WC=T_WC,
        rms_m=system.rms_m,
        n_inliers=system.n_inliers,
        n_overlap=system.n_overlap,
        n_pixels=int((levels[-1].depth_m > 0).sum()),
        eigenvalues=tuple(last.eigenvalues.tolist()),
        degenerate=last.degenerate,
        history=tuple(history),
    )


@dataclass(frozen=True, eq=False)
class _Rows:
    """All rows of the least squares: depth, and those that join it."""

    surface: Surface
    config: TrackingConfig
    extra: ExtraRows | None
    pictures: Pictures | None

    def at(
        self, level: DepthLevel, T_WC: Tensor, max_distance_m: float
    ) -> tuple[IcpSystem, IcpSystem]:
        """The system of depth alone at a pose, and that of all rows."""
        config = self.config
        T_on_device = T_WC.to(self.surface.depth_m.device)
        min_cosine = math.cos(math.radians(config.max_angle_deg))
        gates = {
            "max_distance_m": max_distance_m,
            "min_cosine": min_cosine,
            "even_to_m": config.even_to_m,
        }
        system = joint_system = icp_system(level, T_on_device, self.surface, **gates)
        if self.pictures is not None and config.brightness_m:
            H, b = self.pictures.system(level, T_on_device, max_distance_m).normal_equations()
            joint_system = joint_system.plus(config.brightness_m**2 * H, config.brightness_m**2 * b)
        if self.extra is not None:
            H, b = self.extra(T_WC)
            A = recentred(self.surface.T_WC[:3, 3])
            joint_system = joint_system.plus(A.T @ H @ A, A.T @ b)
        return system, joint_system


def _extent(level: DepthLevel, even_to_m: float | None) -> Extent:
    """Weighted mean and spread of the points in the camera frame."""
    rows = level.depth_m > 0
    points = depth_to_points(level.camera, level.depth_m)[rows]
    weight = depth_weight(level.depth_m[rows], even_to_m)
    share = weight / sum_rows(weight).clamp_min(1e-12)
    middle = sum_rows(share[:, None] * points)
    squares = (points - middle).square().sum(1)
    extent = float(sum_rows(share * squares).sqrt())
    return Extent(centre=middle.double().cpu(), spread_m=max(extent, 1e-3))


def _step(
    system: IcpSystem, T_WC: Tensor, o: Tensor, points: Extent, config: TrackingConfig
) -> Step:
    extent = Extent(centre=se3.apply(T_WC, points.centre) - o, spread_m=points.spread_m)
    return solve_step(system, extent, damping=DAMPING, min_eigenvalue=config.min_eigenvalue)


@piece
def next_pose(
    T: Float[Tensor, "4 4"],
    system: IcpSystem,
    step: Step,
) -> Float[Tensor, "4 4"]:
    """The pose after a Gauss-Newton step, T <- exp(xi) T.

    Args:
        T: Pose before it, with its origin moved to the point o about which the twist turns,
            float64.
        system: Normal equations H, b at that pose.
        step: Their solution.

    Differentiable: no. Source: Peng et al. 2024, Eq. 10.
    """
    return se3.exp(step.xi) @ T
