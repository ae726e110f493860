"""Least squares over all poses and landmarks together: bundle adjustment (``adjust``).

The unknowns are twists of the poses, T_k <- T_k exp(xi_k), and shifts of the landmarks. Their
normal equations are

    [ U    W ] [xi]     [b_p]
    [ W^T  V ] [dx] = - [b_x],    V block-diagonal, one 3x3 block for each landmark.

The landmarks are eliminated (Schur complement): (U - W V^-1 W^T) xi = -(b_p - W V^-1 b_x), a small
system over the poses alone; then dx = -V^-1 (b_x + W^T xi). Errors get Cauchy weights; steps are
damped (Levenberg-Marquardt).

Source: Triggs et al. 2000 (Bundle adjustment: a modern synthesis).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from ..geometry import se3
from ..types import Camera
from .edges import Edge
from .features import DEPTH_SIGMA_PER_M
from .landmark_pose import inverse_or_zero, point_errors, robust_cost, robust_weight
from .landmarks import Observations
from .pose_graph import EdgeTerms

FIRST_DAMPING = 1e-4
"""Added to the diagonal of the normal equations, as a share of it; it falls with each step that
helps."""

ADJUST_LEAST_FALL = 1e-4
"""The steps end when the error falls by less than this share of it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Adjusted:
    """Poses and landmarks after an adjustment."""

    T_WC: Float[Tensor, "K 4 4"]
    """float64; the fixed ones are unchanged."""
    xyz_W: Float[Tensor, "L 3"]
    """float64, metres."""
    error_before: float
    """Half the sum of robust squared errors in standard deviations, at the start ..."""
    error_after: float
    """... and at the end."""


def adjust(
    camera: Camera,
    T_WC: Float[Tensor, "K 4 4"],
    seen: Observations,
    edges: list[Edge],
    fixed: Bool[Tensor, " K"],
    *,
    iterations: int = 8,
) -> Adjusted:
    """Poses and landmark positions that agree best with the observations and with ``edges``.

    The errors of an observation are those of its pixel and of its inverse depth (``point_errors``).

    Args:
        camera: Intrinsics of all keyframes.
        T_WC: Camera-to-world poses to start from. [K, 4, 4]
        seen: Observations, with the landmarks' starting positions.
        edges: Further relative poses, such as those of the front end.
        fixed: Poses that do not change; at least one. [K]
        iterations: Largest number of steps.

    Differentiable: no.
    """
    problem = _Problem(camera, seen, edges, fixed)
    T_WC = T_WC.double()
    xyz = seen.xyz_W.double().numpy()
    error_before = error = problem.error(T_WC, xyz)
    damping = FIRST_DAMPING
    system = problem.system(T_WC, xyz)
    for _ in range(iterations):
        xi, dx = system.step(damping)
        T_new = T_WC @ se3.exp(torch.from_numpy(xi))
        xyz_new = xyz + dx
        error_after = problem.error(T_new, xyz_new)
        if not error_after < error:
            damping *= 10
            continue
        fell = error - error_after
        T_WC = T_new
        xyz = xyz_new
        error = error_after
        if fell < ADJUST_LEAST_FALL * error:
            break
        damping /= 10
        system = problem.system(T_WC, xyz)
    return Adjusted(
        T_WC=T_WC, xyz_W=torch.from_numpy(xyz), error_before=error_before, error_after=error
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Points:
    """The normal equations of the landmarks alone, where all poses are fixed."""

    V: Float[ndarray, "L 3 3"]
    b_x: Float[ndarray, "L 3"]
    n_poses: int

    def V_inv(self, damping: float) -> Float[ndarray, "L 3 3"]:
        """The inverse of each block, damped."""
        if not len(self.V):
            return self.V
        damped_V = self.V * (1 + damping * np.eye(3)) + 1e-9 * np.eye(3)
        return np.linalg.inv(damped_V)

    def step(
        self,
        damping: float,
    ) -> tuple[Float[ndarray, "K 6"], Float[ndarray, "L 3"]]:
        """Twists of the poses, which are 0, and shifts of the landmarks."""
        dx = -(self.V_inv(damping) @ self.b_x[:, :, None])
        return np.zeros((self.n_poses, 6)), dx[:, :, 0]


@dataclass(frozen=True, kw_only=True, eq=False)
class _System(_Points):
    """All normal equations; W is given by the block of each observation."""

    U: Float[ndarray, "K6 K6"]
    W: Float[ndarray, "O 6 3"]
    b_p: Float[ndarray, "K 6"]
    keyframe: ndarray
    landmark: ndarray
    free: ndarray
    """Rows of ``U`` that may change."""

    def step(
        self,
        damping: float,
    ) -> tuple[Float[ndarray, "K 6"], Float[ndarray, "L 3"]]:
        """Twists of the poses and shifts of the landmarks."""
        from scipy.sparse import coo_matrix

        K = len(self.b_p)
        L = len(self.V)
        V_inv = self.V_inv(damping)
        Y = self.W @ V_inv[self.landmark]  # the blocks of W V^-1
        rows = 6 * self.keyframe[:, None] + np.arange(6)
        columns = 3 * self.landmark[:, None] + np.arange(3)
        place = (rows[:, :, None].repeat(3, 2).ravel(), columns[:, None].repeat(6, 1).ravel())
        size = (6 * K, 3 * L)
        all_Y = coo_matrix((Y.ravel(), place), size).tocsr()
        all_W = coo_matrix((self.W.ravel(), place), size).tocsr()

        S = self.U - (all_Y @ all_W.T).toarray()
        S[np.diag_indices_from(S)] += damping * np.diag(self.U) + 1e-9
        b = self.b_p.ravel() - all_Y @ self.b_x.ravel()
        free_S = S[np.ix_(self.free, self.free)]
        xi = np.zeros(6 * K)
        xi[self.free] = -np.linalg.solve(free_S, b[self.free])
        rest = self.b_x + (all_W.T @ xi).reshape(L, 3)
        dx = -(V_inv @ rest[:, :, None])[:, :, 0]
        return xi.reshape(K, 6), dx


class _Problem:
    """What is measured."""

    def __init__(
        self,
        camera: Camera,
        seen: Observations,
        edges: list[Edge],
        fixed: Tensor,
    ):
        self.camera = camera
        self.keyframe = seen.keyframe.numpy()
        self.landmark = seen.landmark.numpy()
        self.of_keyframe = _members(self.keyframe, len(fixed))
        self.of_landmark = _members(self.landmark, len(seen.xyz_W))
        self.uv = seen.uv.numpy()
        self.sigma_px = seen.sigma_px.numpy()
        self.inverse = inverse_or_zero(seen.depth_m.numpy())
        self.sigma_inverse = np.sqrt(
            DEPTH_SIGMA_PER_M**2 + (self.sigma_px * self.inverse / camera.fx) ** 2
        )
        self.free = (6 * (~fixed).nonzero().numpy() + np.arange(6)).ravel()
        self.edges = EdgeTerms(edges) if edges else None

    def error(self, T_WC: Tensor, xyz: ndarray) -> float:
        """Half the sum of robust squared errors."""
        e, _, _, _ = self._errors(T_WC, xyz)
        total = 0.5 * robust_cost(e)
        if self.edges is None:
            return total
        of_edges, *_ = self.edges.errors(T_WC)
        return total + self.edges.robust_error(of_edges)

    def system(self, T_WC: Tensor, xyz: ndarray) -> _Points:
        """The normal equations with the weights of this state."""
        e, by_y, y, R = self._errors(T_WC, xyz)
        w = robust_weight(e)
        K = len(T_WC)
        J_x = by_y @ R.transpose(0, 2, 1)
        wJ_x = w[:, None, None] * J_x
        V = _added(self.of_landmark, wJ_x.transpose(0, 2, 1) @ J_x)
        b_x = _added(self.of_landmark, (wJ_x * e[:, :, None]).sum(1))
        if not len(self.free):
            return _Points(V=V, b_x=b_x, n_poses=K)
        J_p = np.concatenate([-by_y, by_y @ _hat(y)], 2)  # y <- exp(-xi) y
        wJ_p = w[:, None, None] * J_p
        b_p = _added(self.of_keyframe, (wJ_p * e[:, :, None]).sum(1))
        whole = np.zeros((K, K, 6, 6))
        diagonal = np.arange(K)
        whole[diagonal, diagonal] = _added(self.of_keyframe, wJ_p.transpose(0, 2, 1) @ J_p)
        self._add_edges(T_WC, whole, b_p)
        return _System(
            U=whole.transpose(0, 2, 1, 3).reshape(6 * K, 6 * K),
            V=V,
            W=wJ_p.transpose(0, 2, 1) @ J_x,
            b_p=b_p,
            b_x=b_x,
            n_poses=K,
            keyframe=self.keyframe,
            landmark=self.landmark,
            free=self.free,
        )

    def _errors(
        self,
        T_WC: Tensor,
        xyz: ndarray,
    ) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        T = T_WC.numpy()[self.keyframe]
        R = T[:, :3, :3]
        from_camera = xyz[self.landmark] - T[:, :3, 3]
        y = np.einsum("oji,oj->oi", R, from_camera)
        e, by_y = point_errors(
            self.camera, y, self.uv, self.inverse, self.sigma_px, self.sigma_inverse
        )
        return e, by_y, y, R

    def _add_edges(self, T_WC: Tensor, U: ndarray, b_p: ndarray) -> None:
        if self.edges is None:
            return
        e, *J = self.edges.errors(T_WC)
        information = self.edges.weighted(e, True)
        ends = (self.edges.i.numpy(), self.edges.j.numpy())
        for a, J_a in zip(ends, J, strict=True):
            J_information = J_a.mT @ information
            pull = J_information @ e[:, :, None]
            np.add.at(b_p, a, pull[:, :, 0].numpy())
            for c, J_c in zip(ends, J, strict=True):
                np.add.at(U, (a, c), (J_information @ J_c).numpy())


def _members(group: ndarray, n: int) -> Any:
    """A sparse matrix [n, O] that adds up the rows of each of ``n`` groups, in their order."""
    from scipy.sparse import csr_matrix

    count = len(group)
    return csr_matrix(
        (np.ones(count), (group, np.arange(count))),
        (n, count),
    )


def _added(members: Any, values: Float[ndarray, "O *S"]) -> Float[ndarray, "N *S"]:
    """The sum of ``values`` over each group."""
    # -1 has no meaning where there are no rows
    flat = values.reshape(len(values), math.prod(values.shape[1:]))
    return (members @ flat).reshape(members.shape[0], *values.shape[1:])


def _hat(y: ndarray) -> ndarray:
    return se3.hat(torch.from_numpy(y)).numpy()
