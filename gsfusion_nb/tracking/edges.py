"""Measured relative poses between keyframes, and how precise they are.

Units: metres, radians. A relative pose's information is the inverse covariance of xi in T_ij
exp(xi), rotation first (1/rad^2), then translation (1/m^2).
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import se3

ODOMETRY_FLOOR = (0.05, 0.002)
"""Smallest standard deviation that is assumed for the front end, degrees and metres."""

HELD_BY_MAP = 16.0
"""The information of the front end's steps counts this many times, because the errors of steps that
are tracked against a map do not add up as independent ones would. Chosen among 1, 16 and 64 on four
recordings, so the errors of the back end on these are no test of it. One seed each, ATE (RMSE)
after the graph in cm, by GSFusion on the living room, a fast walk with noise and the kitchen, and
by RTG-SLAM on the kitchen: 0.78, 0.19, 1.06, 1.42 with 1; 0.30, 0.16, 0.73, 1.39 with 16; 0.19,
0.17, 0.74, 1.48 with 64. So 1 is too little, and these recordings do not tell 16 from 64."""

MIN_STEPS = 10
"""Steps measured by both front end and landmarks that are needed to estimate the precision of the
front end."""

SLIPPED = 10.0
"""A step at which front end and landmarks differ by more standard deviations than this is a slip of
the front end."""

HALVES = (slice(0, 3), slice(3, 6))
"""Rotation and translation in a tangent vector."""

OTHER_HALF_FIRST = [3, 4, 5, 0, 1, 2]
"""From the order of an ``Edge``'s information, rotation first, to that of ``se3``'s twists, and
back."""


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


def odometry_information(sigma_deg: float, sigma_m: float) -> Float[Tensor, "6 6"]:
    """Information matrix of a relative pose with these standard deviations along each axis;
    rotation first."""
    sigma = torch.tensor(
        [np.radians(sigma_deg)] * 3 + [sigma_m] * 3,
        dtype=torch.float64,
    )
    return torch.diag(sigma**-2)


def with_floor(
    information: Float[Tensor, "6 6"], sigma_deg: float, sigma_m: float
) -> Float[Tensor, "6 6"]:
    """Information after adding these standard deviations to the covariance.

    Hundreds of features would give a tenth of a millimetre if their errors were independent, which
    they are not.
    """
    floor = torch.linalg.inv(odometry_information(sigma_deg, sigma_m))
    return torch.linalg.inv(torch.linalg.inv(information) + floor)


def fit_odometry(edges: list[Edge]) -> list[Edge]:
    """The edges, where those of the front end get the precision that a comparison with the
    landmarks shows.

    The difference of two measurements of one step has the sum of their variances. With d its
    components over all steps that both have measured, for a Gaussian  median(d^2) = 0.455 var(d),
    so

        sigma_odometry^2 = median(d^2) / 0.455 - median(sigma_landmarks^2),

    for rotation and translation each, not below ``ODOMETRY_FLOOR`` and not above the given value,
    so that landmarks do not make a precise front end worse. It counts as ``HELD_BY_MAP``
    measurements. A step that differs by more than ``SLIPPED`` keeps what was given: the precision
    of the others says nothing about a slip. With fewer than ``MIN_STEPS`` such steps, nothing
    changes.
    """
    steps = {e.j: e for e in edges if e.kind == "odometry"}
    both = []
    for e in edges:
        step = steps.get(e.j)
        if e.kind == "landmarks" and step is not None and e.i == step.i:
            both.append((step, e))
    if len(both) < MIN_STEPS:
        return edges
    d2 = torch.stack([_difference(a.T_ij, b.T_ij) for a, b in both]).square()
    s2 = torch.stack([_variances(b.information) for _, b in both])
    given_variances = torch.stack([_variances(a.information) for a, _ in both]).amax(0)
    floor = _variances(odometry_information(*ODOMETRY_FLOOR))
    halves = [d2[:, k].median() / 0.455 - s2[:, k].median() for k in HALVES]
    variances = torch.cat([half.expand(3) for half in halves])
    variances = variances.maximum(floor).minimum(given_variances)
    distance = (d2 / (variances + s2)).sum(1).sqrt()
    slips = {a.j for (a, _), k in zip(both, distance.tolist(), strict=True) if k > SLIPPED}
    information = torch.diag(HELD_BY_MAP / variances)
    fitted_edges = []
    for e in edges:
        is_held = e.kind == "odometry" and e.j not in slips
        fitted_edges.append(replace(e, information=information) if is_held else e)
    return fitted_edges


def _variances(information: Float[Tensor, "6 6"]) -> Float[Tensor, " 6"]:
    """Variance of each component of a measurement."""
    return torch.linalg.inv(information).diagonal()


def edge_error(edge: Edge, T_WC: Float[Tensor, "K 4 4"]) -> float:
    """Length of the edge's error at these poses, in standard deviations: sqrt(xi^T information
    xi)."""
    T_ij = se3.inverse(T_WC[edge.i]) @ T_WC[edge.j]
    xi = _difference(edge.T_ij, T_ij)
    return float((xi @ edge.information @ xi).clamp_min(0).sqrt())


def _difference(
    T_a: Float[Tensor, "4 4"],
    T_b: Float[Tensor, "4 4"],
) -> Float[Tensor, " 6"]:
    """The twist from one pose to another, rotation first."""
    return se3.log((se3.inverse(T_a) @ T_b).double())[OTHER_HALF_FIRST]
