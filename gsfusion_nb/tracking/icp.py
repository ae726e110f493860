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

import math
from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ..backends import piece
from ..config import TrackingConfig
from ..geometry import depth_to_points, se3, sum_rows
from ..types import Camera
from .brightness import Pictures
from .icp_step import Extent, Step, recentred, solve_step
from .icp_system import IcpSystem, depth_weight, icp_system
from .surface import DepthLevel, Surface, depth_pyramid

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
