"""Least squares over landmarks: the pose of one view (``landmark_pose``), and all poses and landmarks (``adjust``).

The unknowns are twists of the poses, T_k <- T_k exp(xi_k), and shifts of the landmarks. Their normal equations are

    [ U    W ] [xi]     [b_p]
    [ W^T  V ] [dx] = - [b_x],    V block-diagonal, one 3x3 block for each landmark.

The landmarks are eliminated (Schur complement): (U - W V^-1 W^T) xi = -(b_p - W V^-1 b_x), a small system over the
poses alone; then dx = -V^-1 (b_x + W^T xi). Errors get Cauchy weights; steps are damped (Levenberg-Marquardt).

Source: Triggs et al. 2000 (Bundle adjustment: a modern synthesis).

The errors of one landmark in one view are those of its pixel and of its inverse depth (``LandmarkRows``). ICP adds
these rows to its own (Eq. 10 of Peng et al. 2024), so that texture determines what the surface leaves open.
Inverse depth is used because its error is the same at all depths for a camera that measures disparity, as the errors
of the pixel are (the stereo keypoints of ORB-SLAM2, Mur-Artal & Tardos 2017).
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from ..backends import op
from ..checks import check_array
from ..geometry import se3
from ..geometry.operands import check_camera, check_operand
from ..types import Camera
from .features import DEPTH_SIGMA_PER_M
from .landmarks import Observations
from .pose_graph import Edge, EdgeTerms

CAUCHY = 2.4
"""Larger errors, in standard deviations, get less weight (95 % efficiency for Gaussian errors)."""

GATE_CHI2 = 11.34
"""A landmark agrees if the squares of its three errors, in standard deviations, sum to less (99 %)."""

NEAREST_M = 0.05
"""Points nearer than this, or behind the camera, give no row."""

ROUNDS = 8
SMALLEST_STEP = 1e-5
"""``landmark_pose`` takes at most this many Gauss-Newton steps, and ends after one smaller than this, metres and
radians."""

DAMPING = 1e-9
"""Added to the diagonal of the normal equations of ``landmark_pose``, as a share of their trace."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LandmarkRows:
    """Landmarks that were found in a frame, one row each, float64."""

    camera: Camera
    xyz_W: Float[ndarray, "P 3"]
    """Positions, world frame, metres."""
    uv: Float[ndarray, "P 2"]
    """Where the frame shows them, pixels."""
    inverse_depth: Float[ndarray, " P"]
    """1 / measured depth, 1/m; 0 where there is none."""
    sigma_px: Float[ndarray, " P"]
    """Standard deviation of ``uv`` and of the landmark's own pixel together."""

    def __len__(self) -> int:
        return len(self.uv)

    def __getitem__(self, rows: Bool[ndarray, " P"] | Int[ndarray, " I"]) -> "LandmarkRows":
        columns = ("xyz_W", "uv", "inverse_depth", "sigma_px")
        return dataclasses.replace(self, **{name: getattr(self, name)[rows] for name in columns})

    def errors(self, T_WC: Float[Tensor, "4 4"]) -> tuple[Float[ndarray, "P 3"], Float[ndarray, "P 3 3"], ndarray]:
        """Errors at a pose, in standard deviations, and their derivative with respect to the point in the camera.

        With y = T_WC^-1 x the errors are  (f_x y_x / y_z + c_x - u) / s,  (f_y y_y / y_z + c_y - v) / s  and
        (1 / y_z - 1 / z) / s_d,  where  s_d^2 = 2 (1.6e-3)^2 + (s / (f z))^2:  the noise of both depths, and the change
        of depth that an error of the pixel causes on a surface at 45 degrees.

        Returns:
            Errors, derivative, and the points y in the camera frame. Rows that do not count are 0.
        """
        T = T_WC.double().numpy()
        y = (self.xyz_W - T[:3, 3]) @ T[:3, :3]
        s_d = np.sqrt(2 * DEPTH_SIGMA_PER_M**2 + (self.sigma_px * self.inverse_depth / self.camera.fx) ** 2)
        return *point_errors(self.camera, y, self.uv, self.inverse_depth, self.sigma_px, s_d), y

    def agree(self, T_WC: Float[Tensor, "4 4"]) -> Bool[ndarray, " P"]:
        """Which landmarks are in front of the camera and where the frame shows them, to 99 % of their errors."""
        e, _, y = self.errors(T_WC)
        return (y[:, 2] > NEAREST_M) & ((e * e).sum(1) < GATE_CHI2)


@dataclass(frozen=True, kw_only=True, eq=False)
class LandmarkSums:
    """Sums over the rows at a pose, float64."""

    H: Float[Tensor, "6 6"]
    """sum w J^T J."""
    b: Float[Tensor, " 6"]
    """sum w J^T e."""
    cost: float
    """Sum of the robust squared errors, ``robust_cost``."""


def check_rows(rows: Any, T_WC: Any, centre: Any = None) -> None:
    """Raise ``ValueError`` for arguments that ``landmark_sums`` and ``landmark_pose`` refuse."""
    if not isinstance(rows, LandmarkRows):
        raise ValueError(f"rows must be LandmarkRows, got {type(rows).__name__}")
    check_camera(rows.camera)
    n, f64 = len(rows.uv), np.float64
    for name, shape in (("xyz_W", (n, 3)), ("uv", (n, 2)), ("inverse_depth", (n,)), ("sigma_px", (n,))):
        check_array(name, getattr(rows, name), shape, f64)
    check_operand("T_WC", T_WC, (4, 4))
    if centre is not None:
        check_operand("centre", centre, (3,))


@op("landmarks", check_rows)
def landmark_sums(
    rows: LandmarkRows, T_WC: Float[Tensor, "4 4"], centre: Float[Tensor, " 3"] | None = None
) -> LandmarkSums:
    """Sums of the errors at a pose, for a twist about ``centre`` along the world's axes, translation first.

    It moves the camera as ICP's does, T_WC <- shift(o) exp(xi) shift(-o) T_WC, so a landmark moves in the camera by
    dy = -R^T (rho + omega x (x - o)). Cauchy weights w = 1 / (1 + |e|^2 / 2.4^2) reduce what wrong matches do.

    Args:
        rows: The landmarks.
        T_WC: Camera-to-world pose.
        centre: The point o, metres; by default the world's origin.

    Differentiable: no.
    """
    e, by_y, _ = rows.errors(T_WC)
    R = T_WC[:3, :3].double().numpy()
    J = np.empty((len(rows), 3, 6))
    J[:, :, :3] = -(by_y @ R.T)
    arm = rows.xyz_W if centre is None else rows.xyz_W - centre.double().numpy()
    x, y, z = arm.T[:, :, None]
    g_x, g_y, g_z = (J[:, :, k] for k in range(3))
    for k, turn in enumerate((y * g_z - z * g_y, z * g_x - x * g_z, x * g_y - y * g_x)):
        J[:, :, 3 + k] = turn  # g . (omega x a) = omega . (a x g)
    flat, weighted = J.reshape(-1, 6), (robust_weight(e)[:, None, None] * J).reshape(-1, 6)
    return LandmarkSums(
        H=torch.from_numpy(weighted.T @ flat), b=torch.from_numpy(weighted.T @ e.reshape(-1)), cost=robust_cost(e)
    )


@op("landmarks", check_rows)
def landmark_pose(rows: LandmarkRows, T_WC: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """The pose at which the landmarks fit best, by Gauss-Newton from ``T_WC``; float64.

    Differentiable: no.
    """
    T_WC = T_WC.double().cpu()
    for _ in range(ROUNDS):
        centre = T_WC[:3, 3]
        sums = landmark_sums(rows, T_WC, centre)
        damping = DAMPING * sums.H.trace().clamp_min(1e-12)
        xi = -torch.linalg.solve(sums.H + damping * torch.eye(6, dtype=torch.float64), sums.b)
        T_WC = se3.translate(se3.exp(xi) @ se3.translate(T_WC, -centre), centre)
        if float(xi.abs().max()) < SMALLEST_STEP:
            break
    return T_WC


def robust_cost(e: Float[ndarray, "P 3"]) -> float:
    """Sum of c^2 ln(1 + |e|^2 / c^2) over the rows (Cauchy), c = 2.4 standard deviations."""
    return CAUCHY**2 * float(np.log1p((e * e).sum(1) / CAUCHY**2).sum())


def robust_weight(e: Float[ndarray, "P 3"]) -> Float[ndarray, " P"]:
    """The weight of each row in a Gauss-Newton step of ``robust_cost``."""
    return 1.0 / (1.0 + (e * e).sum(1) / CAUCHY**2)


def inverse_or_zero(depth_m: ndarray) -> ndarray:
    """1 / depth, 1/m; 0 where there is none."""
    return np.where(depth_m > 0, 1.0 / np.maximum(depth_m, 1e-6), 0.0)


def point_errors(
    camera: Camera, y: ndarray, uv: ndarray, inverse_depth: ndarray, sigma_px: ndarray, sigma_inverse: ndarray
) -> tuple[Float[ndarray, "P 3"], Float[ndarray, "P 3 3"]]:
    """Errors of pixel and inverse depth in standard deviations, and their derivative with respect to the points.

    Args:
        camera: Intrinsics.
        y: Points, camera frame, metres. Those behind the camera get no error.
        uv: Measured pixels.
        inverse_depth: 1 / measured depth; 0 where there is none.
        sigma_px, sigma_inverse: Standard deviations.
    """
    c, ahead = camera, y[:, 2] > NEAREST_M
    d = 1.0 / np.where(ahead, y[:, 2], 1.0)
    w, w_d = ahead / sigma_px, np.where(inverse_depth > 0, ahead / sigma_inverse, 0.0)
    u, v = c.fx * y[:, 0] * d, c.fy * y[:, 1] * d
    e = np.stack([w * (u + c.cx - uv[:, 0]), w * (v + c.cy - uv[:, 1]), w_d * (d - inverse_depth)], 1)
    J = np.zeros((len(y), 3, 3))
    J[:, 0, 0], J[:, 0, 2] = w * c.fx * d, -w * u * d
    J[:, 1, 1], J[:, 1, 2] = w * c.fy * d, -w * v * d
    J[:, 2, 2] = -w_d * d * d
    return e, J


FIRST_DAMPING = 1e-4
"""Added to the diagonal of the normal equations, as a share of it; it falls with each step that helps."""

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
    T_WC, xyz = T_WC.double(), seen.xyz_W.double().numpy()
    before = error = problem.error(T_WC, xyz)
    damping = FIRST_DAMPING
    system = problem.system(T_WC, xyz)
    for _ in range(iterations):
        xi, dx = system.step(damping)
        T_new, xyz_new = T_WC @ se3.exp(torch.from_numpy(xi)), xyz + dx
        after = problem.error(T_new, xyz_new)
        if not after < error:
            damping *= 10
            continue
        T_WC, xyz, fell, error = T_new, xyz_new, error - after, after
        if fell < ADJUST_LEAST_FALL * error:
            break
        damping /= 10
        system = problem.system(T_WC, xyz)
    return Adjusted(T_WC=T_WC, xyz_W=torch.from_numpy(xyz), error_before=before, error_after=error)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Points:
    """The normal equations of the landmarks alone, where all poses are fixed."""

    V: Float[ndarray, "L 3 3"]
    b_x: Float[ndarray, "L 3"]
    n_poses: int

    def V_inv(self, damping: float) -> Float[ndarray, "L 3 3"]:
        """The inverse of each block, damped."""
        return np.linalg.inv(self.V * (1 + damping * np.eye(3)) + 1e-9 * np.eye(3)) if len(self.V) else self.V

    def step(self, damping: float) -> tuple[Float[ndarray, "K 6"], Float[ndarray, "L 3"]]:
        """Twists of the poses, which are 0, and shifts of the landmarks."""
        return np.zeros((self.n_poses, 6)), -(self.V_inv(damping) @ self.b_x[:, :, None])[:, :, 0]


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

    def step(self, damping: float) -> tuple[Float[ndarray, "K 6"], Float[ndarray, "L 3"]]:
        """Twists of the poses and shifts of the landmarks."""
        from scipy.sparse import coo_matrix

        K, L = len(self.b_p), len(self.V)
        V_inv = self.V_inv(damping)
        Y = self.W @ V_inv[self.landmark]  # the blocks of W V^-1
        rows = (6 * self.keyframe[:, None] + np.arange(6))[:, :, None].repeat(3, 2).ravel()
        columns = (3 * self.landmark[:, None] + np.arange(3))[:, None].repeat(6, 1).ravel()
        both = [coo_matrix((block.ravel(), (rows, columns)), (6 * K, 3 * L)).tocsr() for block in (Y, self.W)]
        S = self.U - (both[0] @ both[1].T).toarray()
        S[np.diag_indices_from(S)] += damping * np.diag(self.U) + 1e-9
        b = self.b_p.ravel() - both[0] @ self.b_x.ravel()
        xi = np.zeros(6 * K)
        xi[self.free] = -np.linalg.solve(S[np.ix_(self.free, self.free)], b[self.free])
        dx = -(V_inv @ (self.b_x + (both[1].T @ xi).reshape(L, 3))[:, :, None])[:, :, 0]
        return xi.reshape(K, 6), dx


class _Problem:
    """What is measured."""

    def __init__(self, camera: Camera, seen: Observations, edges: list[Edge], fixed: Tensor):
        self.camera = camera
        self.keyframe, self.landmark = seen.keyframe.numpy(), seen.landmark.numpy()
        self.of_keyframe = _members(self.keyframe, len(fixed))
        self.of_landmark = _members(self.landmark, len(seen.xyz_W))
        self.uv, self.sigma_px = seen.uv.numpy(), seen.sigma_px.numpy()
        self.inverse = inverse_or_zero(seen.depth_m.numpy())
        self.sigma_inverse = np.sqrt(DEPTH_SIGMA_PER_M**2 + (self.sigma_px * self.inverse / camera.fx) ** 2)
        self.free = (6 * (~fixed).nonzero().numpy() + np.arange(6)).ravel()
        self.edges = EdgeTerms(edges) if edges else None

    def error(self, T_WC: Tensor, xyz: ndarray) -> float:
        """Half the sum of robust squared errors."""
        e, _, _, _ = self._errors(T_WC, xyz)
        total = 0.5 * robust_cost(e)
        return total if self.edges is None else total + self.edges.robust_error(self.edges.errors(T_WC)[0])

    def system(self, T_WC: Tensor, xyz: ndarray) -> _Points:
        """The normal equations with the weights of this state."""
        e, by_y, y, R = self._errors(T_WC, xyz)
        w, K = robust_weight(e), len(T_WC)
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
        whole[np.arange(K), np.arange(K)] = _added(self.of_keyframe, wJ_p.transpose(0, 2, 1) @ J_p)
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

    def _errors(self, T_WC: Tensor, xyz: ndarray) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        T = T_WC.numpy()[self.keyframe]
        R = T[:, :3, :3]
        y = np.einsum("oji,oj->oi", R, xyz[self.landmark] - T[:, :3, 3])
        return *point_errors(self.camera, y, self.uv, self.inverse, self.sigma_px, self.sigma_inverse), y, R

    def _add_edges(self, T_WC: Tensor, U: ndarray, b_p: ndarray) -> None:
        if self.edges is None:
            return
        e, *J = self.edges.errors(T_WC)
        information = self.edges.weighted(e, True)
        ends = (self.edges.i.numpy(), self.edges.j.numpy())
        for a, J_a in zip(ends, J, strict=True):
            weighted = J_a.mT @ information
            np.add.at(b_p, a, (weighted @ e[:, :, None])[:, :, 0].numpy())
            for c, J_c in zip(ends, J, strict=True):
                np.add.at(U, (a, c), (weighted @ J_c).numpy())


def _members(group: ndarray, n: int) -> Any:
    """A sparse matrix [n, O] that adds up the rows of each of ``n`` groups, in their order."""
    from scipy.sparse import csr_matrix

    return csr_matrix((np.ones(len(group)), (group, np.arange(len(group)))), (n, len(group)))


def _added(members: Any, values: Float[ndarray, "O *S"]) -> Float[ndarray, "N *S"]:
    """The sum of ``values`` over each group."""
    flat = values.reshape(len(values), math.prod(values.shape[1:]))  # -1 has no meaning where there are no rows
    return (members @ flat).reshape(members.shape[0], *values.shape[1:])


def _hat(y: ndarray) -> ndarray:
    return se3.hat(torch.from_numpy(y)).numpy()
