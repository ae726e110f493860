"""Difference between an estimated and the true camera path: alignment, absolute and relative errors."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_finite, check_shape
from ..geometry import se3


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """The similarity  y = scale R x + t  that moves one path onto another."""

    R: Float[Tensor, "3 3"]
    t: Float[Tensor, " 3"]
    """Metres."""
    scale: float

    def apply(self, xyz: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """The points moved by the alignment, metres. [N, 3]"""
        return self.scale * xyz @ self.R.T + self.t


@dataclass(frozen=True, kw_only=True)
class RelativeErrors:
    """Root mean squares of the relative pose error."""

    translation_m: float
    rotation_deg: float
    pairs: int
    """Number of compared pairs of poses."""


def align_umeyama(source: Float[Tensor, "N 3"], target: Float[Tensor, "N 3"], *, with_scale: bool = False) -> Alignment:
    """The rigid (or similarity) transform that minimises  sum |target - (s R source + t)|^2.

    With the covariance of the centred points U D V^T:  R = U S V^T,  s = tr(D S) / var(source),  where
    S = diag(1, 1, +-1) keeps det R = +1. For points on one line the rotation about it is not determined; every choice
    has the same residual.

    Args:
        source: Points to move, metres. [N, 3]
        target: Target points. [N, 3]
        with_scale: Also solve for the scale; else it is 1.

    Returns:
        The alignment, in float64.

    Raises:
        ValueError: with fewer than 3 points, or with a scale if all points coincide.

    Differentiable: no. Source: Umeyama 1991, Eq. 34-42.
    """
    check_shape("source", source, tuple(target.shape))
    if len(source) < 3:
        raise ValueError(f"an alignment needs at least 3 positions, got {len(source)}")
    x, y = source.double(), target.double()
    mean_x, mean_y = x.mean(0), y.mean(0)
    variance = float((x - mean_x).square().sum(1).mean())
    if with_scale and variance == 0:
        raise ValueError("an alignment with scale needs positions that differ, but all source positions coincide")
    covariance = (y - mean_y).T @ (x - mean_x) / len(x)
    U, D, Vh = torch.linalg.svd(covariance)
    S = torch.ones(3, dtype=torch.float64, device=x.device)
    if torch.linalg.det(U) * torch.linalg.det(Vh) < 0:
        S[2] = -1.0
    R = U @ torch.diag(S) @ Vh
    scale = float((D * S).sum()) / variance if with_scale else 1.0
    return Alignment(R=R, t=mean_y - scale * R @ mean_x, scale=scale)


def ate_rmse(
    estimate: Float[Tensor, "N 4 4"],
    reference: Float[Tensor, "N 4 4"],
    *,
    align: bool = True,
    with_scale: bool = False,
) -> float:
    """Absolute trajectory error: root mean square distance of camera centres, metres.

    Args:
        estimate: Camera-to-world poses, one per reference pose. [N, 4, 4]
        reference: True poses. [N, 4, 4]
        align: First align the estimate with the reference (the world frame of a map is arbitrary); False for given
            poses.
        with_scale: The alignment may also scale (monocular systems only).

    Returns:
        Metres. For a camera that only rotates, the number after an alignment has no meaning.

    Raises:
        ValueError: without poses, with non-finite ones, or too few to align.

    Differentiable: no. Source: Sturm et al. 2012, section V-A; alignment by ``align_umeyama``.
    """
    _check_paths(estimate, reference)
    if with_scale and not align:
        raise ValueError("with_scale needs align=True: without an alignment there is no scale to solve for")
    x, y = estimate[:, :3, 3].double(), reference[:, :3, 3].double()
    if align:
        x = align_umeyama(x, y, with_scale=with_scale).apply(x)
    return float((x - y).square().sum(1).mean().sqrt())


def rpe(
    estimate: Float[Tensor, "N 4 4"], reference: Float[Tensor, "N 4 4"], *, delta_frames: int = 1
) -> RelativeErrors:
    """Relative pose error over every pair (i, i + delta):  E_i = (Q_i^-1 Q_{i+delta})^-1 (P_i^-1 P_{i+delta}).

    Args:
        estimate: Camera-to-world poses P. [N, 4, 4]
        reference: True poses Q. [N, 4, 4]
        delta_frames: Distance of the two poses of a pair, frames.

    Returns:
        Root mean squares of E's translation (metres) and rotation angle (degrees). No alignment is involved.

    Differentiable: no. Source: Sturm et al. 2012, section V-B.
    """
    _check_paths(estimate, reference)
    if not 1 <= delta_frames < len(estimate):
        raise ValueError(f"delta_frames must be between 1 and {len(estimate) - 1}, got {delta_frames}")
    P, Q = estimate.double(), reference.double()
    step_P = se3.inverse(P[:-delta_frames]) @ P[delta_frames:]
    step_Q = se3.inverse(Q[:-delta_frames]) @ Q[delta_frames:]
    E = se3.inverse(step_Q) @ step_P
    angle = torch.rad2deg(se3.rotation_angle(E[:, :3, :3]))
    return RelativeErrors(
        translation_m=float(E[:, :3, 3].square().sum(1).mean().sqrt()),
        rotation_deg=float(angle.square().mean().sqrt()),
        pairs=len(E),
    )


def trajectory_scores(estimate: Float[Tensor, "N 4 4"], reference: Float[Tensor, "N 4 4"]) -> dict[str, float]:
    """Absolute and relative errors of a path, named as in metrics.json.

    Args:
        estimate: Camera-to-world poses, at least 3. [N, 4, 4]
        reference: True poses. [N, 4, 4]
    """
    _check_paths(estimate, reference)
    x, y = estimate[:, :3, 3].double(), reference[:, :3, 3].double()
    distance = (align_umeyama(x, y).apply(x) - y).norm(dim=1)
    steps = rpe(estimate, reference)
    return {
        "ate_rmse_m": float(distance.square().mean().sqrt()),
        "ate_mean_m": float(distance.mean()),
        "drift_m": float((x[-1] - y[-1]).norm()),
        "rpe_translation_m": steps.translation_m,
        "rpe_rotation_deg": steps.rotation_deg,
    }


def _check_paths(estimate: Tensor, reference: Tensor) -> None:
    check_shape("estimate", estimate, tuple(reference.shape))
    if len(estimate) == 0:
        raise ValueError("a trajectory error needs at least one pose, got none")
    check_finite("estimate", estimate)
    check_finite("reference", reference)
