"""Sums over the landmarks that a frame sees, and the pose at which they fit best, in float64.

The formulas are those of ``gsfusion_nb.tracking.landmark_pose``. A frame sees some hundred
landmarks, so one thread takes them in order; whole Gauss-Newton steps run without leaving the
kernel.
"""

# Arrays are passed on as tuples, which pyright cannot follow:
# pyright: reportCallIssue=false

from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from gsfusion_nb.tracking.features import DEPTH_SIGMA_PER_M
from gsfusion_nb.tracking.landmark_pose import (
    CAUCHY,
    DAMPING,
    NEAREST_M,
    ROUNDS,
    SMALLEST_STEP,
    LandmarkRows,
    LandmarkSums,
)

from ..runtime.arguments import lens_of
from ..runtime.numba.scalars import solve_into, turn_about_camera

_SQUARE = CAUCHY**2
_DEPTH_VARIANCE = 2.0 * DEPTH_SIGMA_PER_M**2


class Rows(NamedTuple):
    """The columns of ``LandmarkRows``."""

    xyz_W: np.ndarray
    uv: np.ndarray
    inverse_depth: np.ndarray
    sigma_px: np.ndarray


def landmark_sums(rows: LandmarkRows, T_WC: Tensor, centre: Tensor | None = None) -> LandmarkSums:
    """See ``gsfusion_nb.tracking.landmark_pose.landmark_sums``."""
    H = np.empty((6, 6))
    b = np.empty(6)
    about = np.zeros(3) if centre is None else centre.detach().cpu().double().numpy()
    cost = _sums(_columns(rows), _numbers(T_WC), lens_of(rows.camera), about, H, b)
    return LandmarkSums(H=torch.from_numpy(H), b=torch.from_numpy(b), cost=cost)


def landmark_pose(rows: LandmarkRows, T_WC: Tensor) -> Tensor:
    """See ``gsfusion_nb.tracking.landmark_pose.landmark_pose``."""
    T = _numbers(T_WC).copy()
    _fit(_columns(rows), T, lens_of(rows.camera))
    return torch.from_numpy(T)


def _columns(rows: LandmarkRows) -> Rows:
    columns = (rows.xyz_W, rows.uv, rows.inverse_depth, rows.sigma_px)
    return Rows(*(np.ascontiguousarray(column) for column in columns))


def _numbers(T_WC: Tensor) -> np.ndarray:
    return T_WC.detach().cpu().double().contiguous().numpy()


@njit(cache=True, error_model="numpy")
def _sums(rows, T, lens, centre, H, b):
    """Write the sums to ``H`` and ``b``; returns the cost."""
    H[:] = 0.0
    b[:] = 0.0
    cost = 0.0
    J = np.empty((3, 6))
    e = np.empty(3)
    for p in range(rows.uv.shape[0]):
        X = rows.xyz_W[p, 0]
        Y = rows.xyz_W[p, 1]
        Z = rows.xyz_W[p, 2]
        d0 = X - T[0, 3]
        d1 = Y - T[1, 3]
        d2 = Z - T[2, 3]
        z = T[0, 2] * d0 + T[1, 2] * d1 + T[2, 2] * d2
        if not z > NEAREST_M:
            continue
        x = T[0, 0] * d0 + T[1, 0] * d1 + T[2, 0] * d2
        y = T[0, 1] * d0 + T[1, 1] * d1 + T[2, 1] * d2
        sigma = rows.sigma_px[p]
        rho = rows.inverse_depth[p]
        d = 1.0 / z
        w = 1.0 / sigma
        w_d = 0.0
        if rho > 0.0:
            slope = sigma * rho / lens.fx
            w_d = 1.0 / np.sqrt(_DEPTH_VARIANCE + slope * slope)
        u = lens.fx * x * d
        v = lens.fy * y * d
        e[0] = w * (u + lens.cx - rows.uv[p, 0])
        e[1] = w * (v + lens.cy - rows.uv[p, 1])
        e[2] = w_d * (d - rho)
        a_u = w * lens.fx * d
        a_v = w * lens.fy * d
        c_u = -w * u * d
        c_v = -w * v * d
        c_d = -w_d * d * d
        for k in range(3):
            J[0, k] = -(a_u * T[k, 0] + c_u * T[k, 2])
            J[1, k] = -(a_v * T[k, 1] + c_v * T[k, 2])
            J[2, k] = -c_d * T[k, 2]
        X = X - centre[0]
        Y = Y - centre[1]
        Z = Z - centre[2]
        for r in range(3):
            J[r, 3] = Y * J[r, 2] - Z * J[r, 1]
            J[r, 4] = Z * J[r, 0] - X * J[r, 2]
            J[r, 5] = X * J[r, 1] - Y * J[r, 0]
        square = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
        weight = 1.0 / (1.0 + square / _SQUARE)
        cost += _SQUARE * np.log1p(square / _SQUARE)
        for i in range(6):
            g0 = weight * J[0, i]
            g1 = weight * J[1, i]
            g2 = weight * J[2, i]
            b[i] += g0 * e[0] + g1 * e[1] + g2 * e[2]
            for j in range(i + 1):
                H[i, j] += g0 * J[0, j] + g1 * J[1, j] + g2 * J[2, j]
    for i in range(6):
        for j in range(i):
            H[j, i] = H[i, j]
    return cost


@njit(cache=True, error_model="numpy")
def _fit(rows, T, lens):
    """Move the pose T [4, 4] to where the landmarks fit best."""
    H = np.empty((6, 6))
    b = np.empty(6)
    xi = np.empty(6)
    for _ in range(ROUNDS):
        _sums(rows, T, lens, T[:3, 3].copy(), H, b)
        trace = H[0, 0] + H[1, 1] + H[2, 2] + H[3, 3] + H[4, 4] + H[5, 5]
        for i in range(6):
            H[i, i] += DAMPING * max(trace, 1e-12)
            b[i] = -b[i]
        solve_into(H, b, xi)
        turn_about_camera(T, xi)
        if np.abs(xi).max() < SMALLEST_STEP:
            break
