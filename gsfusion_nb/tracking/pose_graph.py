"""Least squares over the keyframes' poses, from relative poses (GTSAM).

Units: metres, radians. A relative pose's information is the inverse covariance of xi in T_ij exp(xi), rotation
first (1/rad^2), then translation (1/m^2); GTSAM orders a pose's tangent in the same way.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_shape
from ..geometry import se3

LOOP_CAUCHY = 2.0
"""A loop whose error is this many standard deviations has half its weight; at 100 almost none. With 1 the only loop
after a long drift was not closed in 2 of 10 cases, with 2 in none."""

TRACK_HUBER = 3.0
"""Larger errors of relative poses between neighbours, in standard deviations, count linearly instead of quadratically,
because the front end may slip once."""

ODOMETRY_FLOOR = (0.05, 0.002)
"""Smallest standard deviation that is assumed for the front end, degrees and metres."""

HELD_BY_MAP = 16.0
"""The information of the front end's steps counts this many times, because the errors of steps that are tracked
against a map do not add up as independent ones would. Chosen among 1, 16 and 64 on four recordings, so the errors of
the back end on these are no test of it. One seed each, ATE (RMSE) after the graph in cm, by GSFusion on the living
room, a fast walk with noise and the kitchen, and by RTG-SLAM on the kitchen: 0.78, 0.19, 1.06, 1.42 with 1; 0.30, 0.16,
0.73, 1.39 with 16; 0.19, 0.17, 0.74, 1.48 with 64. So 1 is too little, and these recordings do not tell 16 from 64."""

MIN_STEPS = 10
"""Steps measured by both front end and landmarks that are needed to estimate the precision of the front end."""

SLIPPED = 10.0
"""A step at which front end and landmarks differ by more standard deviations than this is a slip of the front end."""

_HALVES = (slice(0, 3), slice(3, 6))
"""Rotation and translation in a tangent vector."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Edge:
    """A measured relative pose between two keyframes."""

    i: int
    j: int
    T_ij: Float[Tensor, "4 4"]
    """Camera j to camera i, float64."""
    information: Float[Tensor, "6 6"]
    """Inverse covariance, rotation first: 1/rad^2 and 1/m^2."""
    kind: Literal["odometry", "landmarks", "loop"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Optimised:
    """Poses that fit the graph best."""

    T_WC: Float[Tensor, "K 4 4"]
    """float64; the first pose does not change."""
    error_before: float
    """Half the sum of (robust) squared errors in standard deviations, at the start ..."""
    error_after: float
    """... and at the end."""


def require_gtsam() -> Any:
    """The module ``gtsam``.

    Raises:
        ImportError: it is not installed; the message says how to install it.
    """
    try:
        import gtsam
    except ImportError as e:
        raise ImportError(
            f"the back end needs GTSAM, which cannot be imported ({e}); to install it: pip install 'gsfusion-nb[slam]'"
        ) from None
    return gtsam


def odometry_information(sigma_deg: float, sigma_m: float) -> Float[Tensor, "6 6"]:
    """Information matrix of a relative pose with these standard deviations along each axis; rotation first."""
    sigma = torch.tensor([np.radians(sigma_deg)] * 3 + [sigma_m] * 3, dtype=torch.float64)
    return torch.diag(sigma**-2)


def with_floor(information: Float[Tensor, "6 6"], sigma_deg: float, sigma_m: float) -> Float[Tensor, "6 6"]:
    """Information after adding these standard deviations to the covariance.

    Hundreds of features would give a tenth of a millimetre if their errors were independent, which they are not.
    """
    floor = torch.linalg.inv(odometry_information(sigma_deg, sigma_m))
    return torch.linalg.inv(torch.linalg.inv(information) + floor)


def fit_odometry(edges: list[Edge]) -> list[Edge]:
    """The edges, where those of the front end get the precision that a comparison with the landmarks shows.

    The difference of two measurements of one step has the sum of their variances. With d its components over all steps
    that both have measured, for a Gaussian  median(d^2) = 0.455 var(d), so

        sigma_odometry^2 = median(d^2) / 0.455 - median(sigma_landmarks^2),

    for rotation and translation each, not below ``ODOMETRY_FLOOR`` and not above the given value, so that landmarks do
    not make a precise front end worse. It counts as ``HELD_BY_MAP`` measurements. A step that differs by more than
    ``SLIPPED`` keeps what was given: the precision of the others says nothing about a slip. With fewer than
    ``MIN_STEPS`` such steps, nothing changes.
    """
    steps = {e.j: e for e in edges if e.kind == "odometry"}
    both = [(steps[e.j], e) for e in edges if e.kind == "landmarks" and e.j in steps and e.i == steps[e.j].i]
    if len(both) < MIN_STEPS:
        return edges
    d2 = torch.stack([_log(se3.inverse(a.T_ij) @ b.T_ij) for a, b in both]).square()
    s2 = torch.stack([torch.linalg.inv(b.information).diagonal() for _, b in both])
    given = torch.stack([torch.linalg.inv(a.information).diagonal() for a, _ in both]).amax(0)
    floor = torch.linalg.inv(odometry_information(*ODOMETRY_FLOOR)).diagonal()
    fitted = torch.cat([(d2[:, k].median() / 0.455 - s2[:, k].median()).expand(3) for k in _HALVES])
    fitted = fitted.maximum(floor).minimum(given)
    off = (d2 / (fitted + s2)).sum(1).sqrt()
    slips = {a.j for (a, _), k in zip(both, off.tolist(), strict=True) if k > SLIPPED}
    information = torch.diag(HELD_BY_MAP / fitted)
    return [replace(e, information=information) if e.kind == "odometry" and e.j not in slips else e for e in edges]


def edge_error(edge: Edge, T_WC: Float[Tensor, "K 4 4"]) -> float:
    """Length of the edge's error at these poses, in standard deviations: sqrt(xi^T information xi)."""
    xi = _log(se3.inverse(edge.T_ij) @ se3.inverse(T_WC[edge.i]) @ T_WC[edge.j])
    return float((xi @ edge.information @ xi).clamp_min(0).sqrt())


def optimise_poses(T_WC: Float[Tensor, "K 4 4"], edges: list[Edge], *, iterations: int = 50) -> Optimised:
    """Poses that agree best with the relative poses; the first pose is fixed.

    minimise  sum rho(|log(T_ij^-1 T_i^-1 T_j)|_information), with rho Huber for steps between neighbours and Cauchy
    for loops: a false loop contradicts all others and loses its weight. Levenberg-Marquardt is started twice, from the
    present poses and from the optimum without robust weights of loops, because after a long drift also the first true
    loop has a large error. The lower of the two minima is used.

    Args:
        T_WC: Camera-to-world poses to start from. [K, 4, 4]
        edges: Relative poses; every keyframe must be connected with the first one.
        iterations: Largest number of steps.

    Raises:
        ImportError: without GTSAM.

    Differentiable: no.
    """
    check_shape("T_WC", T_WC, ("K", 4, 4))
    found = _fit(T_WC, T_WC, edges, iterations, robust=True)
    if not any(e.kind == "loop" for e in edges):
        return found
    closed = _fit(T_WC, T_WC, edges, iterations, robust=False)
    other = _fit(T_WC, closed.T_WC, edges, iterations, robust=True)
    return other if other.error_after < found.error_after else found


def _fit(T_WC: Tensor, start: Tensor, edges: list[Edge], iterations: int, *, robust: bool) -> Optimised:
    gtsam = require_gtsam()
    graph, values = _start(gtsam, T_WC)
    for edge in edges:
        graph.add(_between(gtsam, edge, robust))
    before = float(graph.error(values))
    return replace(_solve(gtsam, graph, _start(gtsam, start)[1], len(T_WC), iterations), error_before=before)


def _start(gtsam: Any, T_WC: Tensor) -> tuple[Any, Any]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, T in enumerate(T_WC.double().numpy()):
        values.insert(k, gtsam.Pose3(T))
    if len(T_WC):
        hold = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
        graph.add(gtsam.PriorFactorPose3(0, values.atPose3(0), hold))
    return graph, values


def _between(gtsam: Any, edge: Edge, robust: bool = True) -> Any:
    noise = gtsam.noiseModel.Gaussian.Information(edge.information.numpy())
    estimators = gtsam.noiseModel.mEstimator
    if edge.kind == "loop" and robust:
        noise = gtsam.noiseModel.Robust.Create(estimators.Cauchy.Create(LOOP_CAUCHY), noise)
    else:
        noise = gtsam.noiseModel.Robust.Create(estimators.Huber.Create(TRACK_HUBER), noise)
    return gtsam.BetweenFactorPose3(edge.i, edge.j, gtsam.Pose3(edge.T_ij.numpy()), noise)


def _solve(gtsam: Any, graph: Any, values: Any, poses: int, iterations: int) -> Optimised:
    before = float(graph.error(values))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(iterations)
    parameters.setRelativeErrorTol(1e-5)
    done = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    T_WC = [torch.from_numpy(np.array(done.atPose3(k).matrix())) for k in range(poses)]
    stacked = torch.stack(T_WC) if T_WC else torch.zeros((0, 4, 4), dtype=torch.float64)
    return Optimised(T_WC=stacked, error_before=before, error_after=float(graph.error(done)))


def _log(T: Float[Tensor, "4 4"]) -> Float[Tensor, " 6"]:
    return torch.from_numpy(np.array(require_gtsam().Pose3.Logmap(require_gtsam().Pose3(T.double().numpy()))))
