"""Difference between an estimated and the true camera path: alignment, absolute and relative
errors."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_finite, check_shape
from ..errors import ArgumentError
from ..geometry import se3


def align_umeyama(
    source: Float[Tensor, "N 3"], target: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, " 3"]]:
    """R and t of the rigid transform that minimises  sum |target - (R source + t)|^2.

    With the covariance of the centred points U D V^T:  R = U S V^T,  where S = diag(1, 1, +-1)
    keeps det R = +1. For points on one line the rotation about it is not determined; every choice
    has the same residual.

    Args:
        source: Points to move, metres. [N, 3]
        target: Target points. [N, 3]

    Returns:
        R and t (metres), in float64.

    Raises:
        ValueError: with fewer than 3 points.

    Differentiable: no. Source: Umeyama 1991, Eq. 34-42.
    """
    check_shape("source", source, tuple(target.shape))
    if len(source) < 3:
        raise ArgumentError(f"an alignment needs at least 3 positions, got {len(source)}")
    x = source.double()
    y = target.double()
    mean_x = x.mean(0)
    mean_y = y.mean(0)
    U, _, Vh = torch.linalg.svd((y - mean_y).T @ (x - mean_x) / len(x))
    S = torch.ones(3, dtype=torch.float64, device=x.device)
    if torch.linalg.det(U) * torch.linalg.det(Vh) < 0:
        S[2] = -1.0
    R = U @ torch.diag(S) @ Vh
    return R, mean_y - R @ mean_x


def ate_rmse(
    estimate: Float[Tensor, "N 4 4"],
    reference: Float[Tensor, "N 4 4"],
    *,
    align: bool = True,
) -> float:
    """Absolute trajectory error: root mean square distance of camera centres, metres.

    Args:
        estimate: Camera-to-world poses, one per reference pose. [N, 4, 4]
        reference: True poses. [N, 4, 4]
        align: First align the estimate with the reference (the world frame of a map is arbitrary);
            False for given poses.

    Returns:
        Metres. For a camera that only rotates, the number after an alignment has no meaning.

    Raises:
        ValueError: without poses, with non-finite ones, or too few to align.

    Differentiable: no. Source: Sturm et al. 2012, section V-A; alignment by ``align_umeyama``.
    """
    _check_paths(estimate, reference)
    return float(_distances(estimate, reference, align).square().mean().sqrt())


def _distances(
    estimate: Tensor,
    reference: Tensor,
    align: bool = True,
) -> Float[Tensor, " N"]:
    x = estimate[:, :3, 3].double()
    y = reference[:, :3, 3].double()
    if align:
        R, t = align_umeyama(x, y)
        x = x @ R.T + t
    return (x - y).norm(dim=1)


def rpe(
    estimate: Float[Tensor, "N 4 4"],
    reference: Float[Tensor, "N 4 4"],
) -> tuple[float, float]:
    """Relative pose error over neighbouring poses:  E_i = (Q_i^-1 Q_{i+1})^-1 (P_i^-1 P_{i+1}).

    Args:
        estimate: Camera-to-world poses P, at least 2. [N, 4, 4]
        reference: True poses Q. [N, 4, 4]

    Returns:
        Root mean squares of E's translation (metres) and rotation angle (degrees). No alignment is
        involved.

    Differentiable: no. Source: Sturm et al. 2012, section V-B.
    """
    _check_paths(estimate, reference)
    P = estimate.double()
    Q = reference.double()
    E = se3.inverse(se3.inverse(Q[:-1]) @ Q[1:]) @ (se3.inverse(P[:-1]) @ P[1:])
    angle = torch.rad2deg(se3.rotation_angle(E[:, :3, :3]))
    return float(E[:, :3, 3].square().sum(1).mean().sqrt()), float(angle.square().mean().sqrt())


def trajectory_scores(
    estimate: Float[Tensor, "N 4 4"], reference: Float[Tensor, "N 4 4"]
) -> dict[str, float]:
    """Absolute and relative errors of a path, named as in metrics.json.

    Args:
        estimate: Camera-to-world poses, at least 3. [N, 4, 4]
        reference: True poses. [N, 4, 4]
    """
    _check_paths(estimate, reference)
    distance = _distances(estimate, reference)
    translation_m, rotation_deg = rpe(estimate, reference)
    return {
        "ate_rmse_m": float(distance.square().mean().sqrt()),
        "ate_mean_m": float(distance.mean()),
        "drift_m": float((estimate[-1, :3, 3].double() - reference[-1, :3, 3].double()).norm()),
        "rpe_translation_m": translation_m,
        "rpe_rotation_deg": rotation_deg,
    }


def _check_paths(estimate: Tensor, reference: Tensor) -> None:
    check_shape("estimate", estimate, tuple(reference.shape))
    if len(estimate) == 0:
        raise ArgumentError("a trajectory error needs at least one pose, got none")
    check_finite("estimate", estimate)
    check_finite("reference", reference)
