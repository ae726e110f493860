"""The step of ICP: a twist from the normal equations, only along the directions that the scene
determines."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import se3
from .icp_system import IcpSystem


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
