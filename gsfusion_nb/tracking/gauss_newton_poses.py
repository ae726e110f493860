"""The pose graph written by hand: Gauss-Newton over the keyframes' poses, in plain PyTorch, without GTSAM.

A pose is changed in its own camera frame, T_k <- T_k exp(xi_k), translation first. For an edge that measured T_ij,

    e = log(T_ij^-1 T_i^-1 T_j),   de/dxi_j = J,   de/dxi_i = -J Ad(T_j^-1 T_i),
    J = I + A/2 + A^2/12 - A^4/720  with  A = [[hat(omega), hat(rho)], [0, hat(omega)]]  of  e = (rho, omega).

One step solves  H xi = -b,  H = sum J_a^T Omega J_c,  b = sum J_a^T Omega e,  over the ends a, c of all edges. The
first pose is fixed. ``optimise_poses`` in ``pose_graph.py`` solves the same problem with GTSAM, which uses that H is
sparse.

Source: Sola et al. 2018 (A micro Lie theory), Grisetti et al. 2010 (A tutorial on graph-based SLAM).
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..backends import piece
from ..checks import check_shape
from ..geometry import se3
from .pose_graph import LOOP_CAUCHY, TRACK_HUBER, Edge, Optimised

CONVERGED = 1e-5
"""The steps end when the error falls by less than this share of it."""

HALVINGS = 8
"""A step that makes the error larger is halved up to this often."""

_TRANSLATION_FIRST = [3, 4, 5, 0, 1, 2]
"""Order of an ``Edge``'s information, which has rotation first, in the twists used here."""


@piece
def relative_pose_error(
    T_i: Float[Tensor, "*E 4 4"], T_j: Float[Tensor, "*E 4 4"], T_ij: Float[Tensor, "*E 4 4"]
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
        torch.linalg.LinAlgError: a pose is not connected with the first one.
    """
    K = len(T_WC)
    H, b = T_WC.new_zeros(K, K, 6, 6), T_WC.new_zeros(K, 6)
    for a, J_a in ((i, J_i), (j, J_j)):
        weighted = J_a.mT @ information
        b.index_add_(0, a, (weighted @ e[:, :, None])[:, :, 0])
        for c, J_c in ((i, J_i), (j, J_j)):
            H.index_put_((a, c), weighted @ J_c, accumulate=True)
    H = H.transpose(1, 2).reshape(6 * K, 6 * K)
    xi = torch.linalg.solve(H[6:, 6:], -b.flatten()[6:]).view(-1, 6)  # the first pose is left out: it is fixed
    return torch.cat([T_WC[:1], T_WC[1:] @ se3.exp(xi)])


def optimise_poses_plain(T_WC: Float[Tensor, "K 4 4"], edges: list[Edge], *, iterations: int = 50) -> Optimised:
    """``optimise_poses`` without GTSAM: the same robust least squares by Gauss-Newton steps, from the same two starts.

    For some hundred poses: H is stored whole, [6 K, 6 K].

    Args:
        T_WC: Camera-to-world poses to start from. [K, 4, 4]
        edges: Relative poses; every keyframe must be connected with the first one.
        iterations: Largest number of steps from each start.

    Raises:
        torch.linalg.LinAlgError: a keyframe is not connected with the first one.

    Differentiable: no.
    """
    check_shape("T_WC", T_WC, ("K", 4, 4))
    T_WC = T_WC.double()
    if len(T_WC) < 2 or not edges:
        return Optimised(T_WC=T_WC, error_before=0.0, error_after=0.0)
    graph = EdgeTerms(edges)
    before = graph.robust_error(graph.errors(T_WC)[0])
    found = _descend(graph, T_WC, iterations, robust=True)
    if any(e.kind == "loop" for e in edges):
        closed, _ = _descend(graph, T_WC, iterations, robust=False)
        other = _descend(graph, closed, iterations, robust=True)
        found = min(found, other, key=lambda descent: descent[1])
    return Optimised(T_WC=found[0], error_before=before, error_after=found[1])


class EdgeTerms:
    """Edges as tensors: their errors, and how much each counts."""

    def __init__(self, edges: list[Edge]):
        self.i, self.j = (torch.tensor([getattr(e, end) for e in edges]) for end in ("i", "j"))
        self.T_ij = torch.stack([e.T_ij for e in edges]).double()
        order = torch.tensor(_TRANSLATION_FIRST)
        self.information = torch.stack([e.information for e in edges]).double()[:, order][:, :, order]
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
        return torch.where(self.is_loop & robust, cauchy, huber)[:, None, None] * self.information

    def _deviations(self, e: Tensor) -> Tensor:
        return torch.einsum("ea,eab,eb->e", e, self.information, e).clamp_min(0).sqrt()


def _descend(graph: EdgeTerms, T_WC: Tensor, iterations: int, *, robust: bool) -> tuple[Tensor, float]:
    """Poses and error after Gauss-Newton steps with robust weights, which are computed again before each step."""
    e, J_i, J_j = graph.errors(T_WC)
    error = graph.robust_error(e, robust)
    for _ in range(iterations):
        proposed = pose_graph_step(T_WC, graph.i, graph.j, e, J_i, J_j, graph.weighted(e, robust))
        xi, share = se3.log(se3.inverse(T_WC) @ proposed), 1.0
        there = graph.errors(proposed)
        after = graph.robust_error(there[0], robust)
        while after > error and share > 0.5**HALVINGS:
            share /= 2
            proposed = T_WC @ se3.exp(share * xi)
            there = graph.errors(proposed)
            after = graph.robust_error(there[0], robust)
        if after > error:
            break
        T_WC, (e, J_i, J_j), fell, error = proposed, there, error - after, after
        if fell <= CONVERGED * error:
            break
    return T_WC, error
