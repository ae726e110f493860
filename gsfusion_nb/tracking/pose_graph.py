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

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..backends import piece
from ..checks import check_shape
from ..geometry import se3
from .edges import OTHER_HALF_FIRST, Edge

LOOP_CAUCHY = 2.0
"""A loop whose error is this many standard deviations has half its weight; at 100 almost none. With
1 the only loop after a long drift was not closed in 2 of 10 cases, with 2 in none."""

TRACK_HUBER = 3.0
"""Larger errors of relative poses between neighbours, in standard deviations, count linearly
instead of quadratically, because the front end may slip once."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Optimised:
    """Poses that fit the graph best."""

    T_WC: Float[Tensor, "K 4 4"]
    """float64; the first pose does not change."""
    error_before: float
    """Half the sum of (robust) squared errors in standard deviations, at the start ..."""
    error_after: float
    """... and at the end."""


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
        order = torch.tensor(OTHER_HALF_FIRST)
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
