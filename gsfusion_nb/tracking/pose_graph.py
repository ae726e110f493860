"""Least squares over the keyframes' poses, from relative poses.

Units: metres, radians. A relative pose's information is the inverse covariance of xi in T_ij
exp(xi), rotation first (1/rad^2), then translation (1/m^2).

``optimise_poses`` takes Gauss-Newton steps. A pose is changed in its own camera frame, T_k <- T_k
exp(xi_k), translation first. For an edge that measured T_ij,

    e = log(T_ij^-1 T_i^-1 T_j),   de/dxi_j = J,   de/dxi_i = -J Ad(T_j^-1 T_i),
    J = I + A/2 + A^2/12 - A^4/720,   A = [ hat(omega)  hat(rho)   ]   of  e = (rho, omega).
                                          [     0       hat(omega) ]

One step solves  H xi = -b,  H = sum J_a^T Omega J_c,  b = sum J_a^T Omega e,  over the ends a, c of
all edges. The first pose is fixed. An edge touches two poses only, so H is sparse, and SuperLU
solves it.

Source: Sola et al. 2018 (A micro Lie theory), Grisetti et al. 2010 (A tutorial on graph-based
SLAM).
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..backends import piece
from ..checks import check_shape
from ..geometry import se3

LOOP_CAUCHY = 2.0
"""A loop whose error is this many standard deviations has half its weight; at 100 almost none. With
1 the only loop after a long drift was not closed in 2 of 10 cases, with 2 in none."""

TRACK_HUBER = 3.0
"""Larger errors of relative poses between neighbours, in standard deviations, count linearly
instead of quadratically, because the front end may slip once."""

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

_HALVES = (slice(0, 3), slice(3, 6))
"""Rotation and translation in a tangent vector."""

_OTHER_HALF_FIRST = [3, 4, 5, 0, 1, 2]
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Optimised:
    """Poses that fit the graph best."""

    T_WC: Float[Tensor, "K 4 4"]
    """float64; the first pose does not change."""
    error_before: float
    """Half the sum of (robust) squared errors in standard deviations, at the start ..."""
    error_after: float
    """... and at the end."""


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
    halves = [d2[:, k].median() / 0.455 - s2[:, k].median() for k in _HALVES]
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
    return se3.log((se3.inverse(T_a) @ T_b).double())[_OTHER_HALF_FIRST]


GRAPH_LEAST_FALL = 1e-5
"""The steps end when the error falls by less than this share of it."""

HALVINGS = 8
"""A step that makes the error larger is halved up to this often."""


@piece
def relative_pose_error(
    T_i: Float[Tensor, "*E 4 4"],
    T_j: Float[Tensor, "*E 4 4"],
    T_ij: Float[Tensor, "*E 4 4"],
) -> tuple[Float[Tensor, "*E 6"], Float[Tensor, "*E 6 6"], Float[Tensor, "*E 6 6"]]:
    """Error of measured relative poses, and its derivatives with respect to the poses at both ends.

    Args:
        T_i, T_j: Camera-to-world poses at the ends of each edge. [E, 4, 4]
        T_ij: Measured: camera j to camera i. [E, 4, 4]

    Returns:
        e [E, 6], translation first, metres and radians; de/dxi_i and de/dxi_j [E, 6, 6].

    Differentiable: yes, through torch. Source: equations at the top of this file.
    """
    e = se3.log(se3.inverse(T_ij) @ se3.inverse(T_i) @ T_j)
    A = se3.small_adjoint(e)
    A2 = A @ A
    J = torch.eye(6).to(e) + A / 2 + A2 / 12 - A2 @ A2 / 720
    return e, -J @ se3.adjoint(se3.inverse(T_j) @ T_i), J


@piece
def pose_graph_step(
    T_WC: Float[Tensor, "K 4 4"],
    i: Int[Tensor, " E"],
    j: Int[Tensor, " E"],
    e: Float[Tensor, "E 6"],
    J_i: Float[Tensor, "E 6 6"],
    J_j: Float[Tensor, "E 6 6"],
    information: Float[Tensor, "E 6 6"],
) -> Float[Tensor, "K 4 4"]:
    """The poses after one Gauss-Newton step; the first pose does not change.

    Args:
        T_WC: Camera-to-world poses. [K, 4, 4]
        i, j: Numbers of the poses at the ends of each edge. [E]
        e, J_i, J_j: Error of each edge and its derivatives, from ``relative_pose_error``.
        information: Weight of each edge, Omega: the inverse covariance of e. [E, 6, 6]

    Raises:
        RuntimeError: a pose is not connected with the first one.
    """
    from scipy.sparse import bsr_array
    from scipy.sparse.linalg import splu

    K = len(T_WC)
    H = torch.zeros(
        (K, K, 6, 6),
        dtype=T_WC.dtype,
        layout=torch.sparse_coo,
    )
    b = T_WC.new_zeros(K, 6)
    for a, J_a in ((i, J_i), (j, J_j)):
        J_information = J_a.mT @ information
        b.index_add_(
            0,
            a,
            (J_information @ e[:, :, None])[:, :, 0],
        )
        for c, J_c in ((i, J_i), (j, J_j)):
            at = torch.stack((a, c))
            H = H + torch.sparse_coo_tensor(at, J_information @ J_c, H.shape, check_invariants=True)
    H = H.coalesce()
    row, column = H.indices()
    first = torch.searchsorted(row, torch.arange(K + 1))  # number of the first block in each row
    blocks = bsr_array(
        (H.values().numpy(), column.numpy(), first.numpy()),
        shape=(6 * K, 6 * K),
    )
    free = blocks.tocsc()[6:, 6:]  # the first pose is left out: it is fixed
    xi = torch.from_numpy(splu(free, "MMD_AT_PLUS_A").solve(-b.flatten()[6:].numpy())).view(-1, 6)
    return torch.cat([T_WC[:1], T_WC[1:] @ se3.exp(xi)])


def optimise_poses(
    T_WC: Float[Tensor, "K 4 4"], edges: list[Edge], *, iterations: int = 50
) -> Optimised:
    """Poses that agree best with the relative poses; the first pose is fixed.

    minimise  sum rho(|log(T_ij^-1 T_i^-1 T_j)|_information), with rho Huber for steps between
    neighbours and Cauchy for loops: a false loop contradicts all others and loses its weight.
    Gauss-Newton steps are started twice, from the present poses and from the optimum without robust
    weights of loops, because after a long drift also the first true loop has a large error. The
    lower of the two minima is used.

    Args:
        T_WC: Camera-to-world poses to start from. [K, 4, 4]
        edges: Relative poses; every keyframe must be connected with the first one.
        iterations: Largest number of steps from each start.

    Raises:
        RuntimeError: a keyframe is not connected with the first one.

    Differentiable: no.
    """
    check_shape("T_WC", T_WC, ("K", 4, 4))
    T_WC = T_WC.double()
    if len(T_WC) < 2 or not edges:
        return Optimised(T_WC=T_WC, error_before=0.0, error_after=0.0)
    graph = EdgeTerms(edges)
    error_before = graph.robust_error(graph.errors(T_WC)[0])
    best = _descend(graph, T_WC, iterations, robust=True)
    if any(e.kind == "loop" for e in edges):
        T_closed, _ = _descend(graph, T_WC, iterations, robust=False)
        other = _descend(graph, T_closed, iterations, robust=True)
        best = min(best, other, key=lambda descent: descent[1])
    return Optimised(T_WC=best[0], error_before=error_before, error_after=best[1])


class EdgeTerms:
    """Edges as tensors: their errors, and how much each counts."""

    def __init__(self, edges: list[Edge]):
        self.i, self.j = (torch.tensor([getattr(e, end) for e in edges]) for end in ("i", "j"))
        self.T_ij = torch.stack([e.T_ij for e in edges]).double()
        order = torch.tensor(_OTHER_HALF_FIRST)
        self.information = torch.stack([e.information for e in edges]).double()[:, order][
            :, :, order
        ]
        self.is_loop = torch.tensor([e.kind == "loop" for e in edges])

    def errors(self, T_WC: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Error and derivatives of every edge."""
        return relative_pose_error(T_WC[self.i], T_WC[self.j], self.T_ij)

    def robust_error(self, e: Tensor, robust: bool = True) -> float:
        """Half the sum of rho(d), d the length of an edge's error in standard deviations."""
        d = self._deviations(e)
        huber = torch.where(d <= TRACK_HUBER, d**2, TRACK_HUBER * (2 * d - TRACK_HUBER))
        cauchy = LOOP_CAUCHY**2 * torch.log1p((d / LOOP_CAUCHY) ** 2)
        return float(torch.where(self.is_loop & robust, cauchy, huber).sum()) / 2

    def weighted(self, e: Tensor, robust: bool) -> Tensor:
        """Information of every edge times its robust weight rho'(d) / (2 d)."""
        d = self._deviations(e)
        huber = (TRACK_HUBER / d.clamp_min(1e-12)).clamp_max(1.0)
        cauchy = 1 / (1 + (d / LOOP_CAUCHY) ** 2)
        weight = torch.where(self.is_loop & robust, cauchy, huber)
        return weight[:, None, None] * self.information

    def _deviations(self, e: Tensor) -> Tensor:
        return torch.einsum("ea,eab,eb->e", e, self.information, e).clamp_min(0).sqrt()


def _descend(
    graph: EdgeTerms, T_WC: Tensor, iterations: int, *, robust: bool
) -> tuple[Tensor, float]:
    """Poses and error after Gauss-Newton steps with robust weights, which are computed again before
    each step."""
    e, J_i, J_j = graph.errors(T_WC)
    error = graph.robust_error(e, robust)
    for _ in range(iterations):
        T_proposed = pose_graph_step(
            T_WC,
            graph.i,
            graph.j,
            e,
            J_i,
            J_j,
            graph.weighted(e, robust),
        )
        xi = se3.log(se3.inverse(T_WC) @ T_proposed)
        share = 1.0
        errors = graph.errors(T_proposed)
        error_after = graph.robust_error(errors[0], robust)
        while error_after > error and share > 0.5**HALVINGS:
            share /= 2
            T_proposed = T_WC @ se3.exp(share * xi)
            errors = graph.errors(T_proposed)
            error_after = graph.robust_error(errors[0], robust)
        if error_after > error:
            break
        fell = error - error_after
        T_WC = T_proposed
        e, J_i, J_j = errors
        error = error_after
        if fell <= GRAPH_LEAST_FALL * error:
            break
    return T_WC, error
