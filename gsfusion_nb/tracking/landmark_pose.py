"""The pose of one view from points that it shows: their errors, least squares (``landmark_pose``),
which of them agree.

The errors of one landmark in one view are those of its pixel and of its inverse depth
(``LandmarkRows``). ICP adds these rows to its own (Eq. 10 of Peng et al. 2024), so that texture
determines what the surface leaves open. Inverse depth is used because its error is the same at all
depths for a camera that measures disparity, as the errors of the pixel are (the stereo keypoints of
ORB-SLAM2, Mur-Artal & Tardos 2017).
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from ..backends import op
from ..checks import check_array
from ..errors import ArgumentError
from ..geometry import se3
from ..geometry.operands import check_camera, check_operand
from ..types import Camera
from .features import DEPTH_SIGMA_PER_M

CAUCHY = 2.4
"""Larger errors, in standard deviations, get less weight (95 % efficiency for Gaussian errors)."""

GATE_CHI2 = 11.34
"""A landmark agrees if the squares of its three errors, in standard deviations, sum to less (99
%)."""

NEAREST_M = 0.05
"""Points nearer than this, or behind the camera, give no row."""

ROUNDS = 8
SMALLEST_STEP = 1e-5
"""``landmark_pose`` takes at most this many Gauss-Newton steps, and ends after one smaller than
this, metres and radians."""

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

    def errors(
        self, T_WC: Float[Tensor, "4 4"]
    ) -> tuple[Float[ndarray, "P 3"], Float[ndarray, "P 3 3"], ndarray]:
        """Errors at a pose, in standard deviations, and their derivative with respect to the point
        in the camera.

        With y = T_WC^-1 x the errors are  (f_x y_x / y_z + c_x - u) / s,  (f_y y_y / y_z + c_y - v)
        / s  and (1 / y_z - 1 / z) / s_d,  where  s_d^2 = 2 (1.6e-3)^2 + (s / (f z))^2:  the noise
        of both depths, and the change of depth that an error of the pixel causes on a surface at 45
        degrees.

        Returns:
            Errors, derivative, and the points y in the camera frame. Rows that do not count are 0.
        """
        T = T_WC.double().numpy()
        y = (self.xyz_W - T[:3, 3]) @ T[:3, :3]
        s_d = np.sqrt(
            2 * DEPTH_SIGMA_PER_M**2 + (self.sigma_px * self.inverse_depth / self.camera.fx) ** 2
        )
        return *point_errors(
            self.camera,
            y,
            self.uv,
            self.inverse_depth,
            self.sigma_px,
            s_d,
        ), y

    def agree(self, T_WC: Float[Tensor, "4 4"]) -> Bool[ndarray, " P"]:
        """Which landmarks are in front of the camera and where the frame shows them, to 99 % of
        their errors."""
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
        raise ArgumentError(f"rows must be LandmarkRows, got {type(rows).__name__}")
    check_camera(rows.camera)
    n = len(rows.uv)
    f64 = np.float64
    for name, shape in (
        ("xyz_W", (n, 3)),
        ("uv", (n, 2)),
        ("inverse_depth", (n,)),
        ("sigma_px", (n,)),
    ):
        check_array(name, getattr(rows, name), shape, f64)
    check_operand("T_WC", T_WC, (4, 4))
    if centre is not None:
        check_operand("centre", centre, (3,))


@op("landmarks", check_rows)
def landmark_sums(
    rows: LandmarkRows,
    T_WC: Float[Tensor, "4 4"],
    centre: Float[Tensor, " 3"] | None = None,
) -> LandmarkSums:
    """Sums of the errors at a pose, for a twist about ``centre`` along the world's axes,
    translation first.

    It moves the camera as ICP's does, T_WC <- shift(o) exp(xi) shift(-o) T_WC, so a landmark moves
    in the camera by dy = -R^T (rho + omega x (x - o)). Cauchy weights w = 1 / (1 + |e|^2 / 2.4^2)
    reduce what wrong matches do.

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
    # g . (omega x a) = omega . (a x g)
    J[:, :, 3] = y * g_z - z * g_y
    J[:, :, 4] = z * g_x - x * g_z
    J[:, :, 5] = x * g_y - y * g_x
    flat = J.reshape(-1, 6)
    J_weighted = (robust_weight(e)[:, None, None] * J).reshape(-1, 6)
    return LandmarkSums(
        H=torch.from_numpy(J_weighted.T @ flat),
        b=torch.from_numpy(J_weighted.T @ e.reshape(-1)),
        cost=robust_cost(e),
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
        damped_H = sums.H + damping * torch.eye(6, dtype=torch.float64)
        xi = -torch.linalg.solve(damped_H, sums.b)
        T_WC = se3.translate(se3.exp(xi) @ se3.translate(T_WC, -centre), centre)
        if float(xi.abs().max()) < SMALLEST_STEP:
            break
    return T_WC


def robust_cost(e: Float[ndarray, "P 3"]) -> float:
    """Sum of c^2 ln(1 + |e|^2 / c^2) over the rows (Cauchy), c = 2.4 standard deviations."""
    squares = (e * e).sum(1)
    return CAUCHY**2 * float(np.log1p(squares / CAUCHY**2).sum())


def robust_weight(e: Float[ndarray, "P 3"]) -> Float[ndarray, " P"]:
    """The weight of each row in a Gauss-Newton step of ``robust_cost``."""
    return 1.0 / (1.0 + (e * e).sum(1) / CAUCHY**2)


def inverse_or_zero(depth_m: ndarray) -> ndarray:
    """1 / depth, 1/m; 0 where there is none."""
    return np.where(depth_m > 0, 1.0 / np.maximum(depth_m, 1e-6), 0.0)


def point_errors(
    camera: Camera,
    y: ndarray,
    uv: ndarray,
    inverse_depth: ndarray,
    sigma_px: ndarray,
    sigma_inverse: ndarray,
) -> tuple[Float[ndarray, "P 3"], Float[ndarray, "P 3 3"]]:
    """Errors of pixel and inverse depth in standard deviations, and their derivative with respect
    to the points.

    Args:
        camera: Intrinsics.
        y: Points, camera frame, metres. Those behind the camera get no error.
        uv: Measured pixels.
        inverse_depth: 1 / measured depth; 0 where there is none.
        sigma_px, sigma_inverse: Standard deviations.
    """
    c = camera
    is_ahead = y[:, 2] > NEAREST_M
    d = 1.0 / np.where(is_ahead, y[:, 2], 1.0)
    w = is_ahead / sigma_px
    w_d = np.where(inverse_depth > 0, is_ahead / sigma_inverse, 0.0)
    u = c.fx * y[:, 0] * d
    v = c.fy * y[:, 1] * d
    e = np.empty((len(y), 3))
    e[:, 0] = w * (u + c.cx - uv[:, 0])
    e[:, 1] = w * (v + c.cy - uv[:, 1])
    e[:, 2] = w_d * (d - inverse_depth)
    J = np.zeros((len(y), 3, 3))
    J[:, 0, 0] = w * c.fx * d
    J[:, 0, 2] = -w * u * d
    J[:, 1, 1] = w * c.fy * d
    J[:, 1, 2] = -w * v * d
    J[:, 2, 2] = -w_d * d * d
    return e, J
