"""Gauss-Newton steps of the relative pose of two views from matched points, without leaving the kernel; float64.

The formulas are those of ``gsfusion_nb.tracking.matching``. One thread takes the some hundred pairs in order.
"""

# Arrays are passed on as tuples, which pyright cannot follow:
# pyright: reportCallIssue=false

from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from gsfusion_nb.tracking.features import DEPTH_SIGMA_PER_M
from gsfusion_nb.tracking.matching import (
    CAUCHY,
    CONVERGED,
    DAMPING,
    LEAST_DEPTH_SIGMA_M,
    NEAREST_M,
    ROUNDS,
    PointPairs,
)
from gsfusion_nb.types import Camera

from ..runtime.arguments import lens_of
from ..runtime.numba.scalars import solve_into, turn_about_camera


class Pairs(NamedTuple):
    """The columns of ``PointPairs``."""

    xyz_R: np.ndarray
    uv: np.ndarray
    depth_m: np.ndarray
    sigma_px: np.ndarray


def fit_pairs(camera: Camera, pairs: PointPairs, T_RQ: Tensor) -> tuple[Tensor, Tensor]:
    """See ``gsfusion_nb.tracking.matching.fit_pairs``."""
    columns = (pairs.xyz_R, pairs.uv, pairs.depth_m, pairs.sigma_px)
    numbers = Pairs(*(column.detach().contiguous().numpy() for column in columns))
    T = T_RQ.detach().double().contiguous().numpy().copy()
    return torch.from_numpy(T), torch.from_numpy(_fit(numbers, T, lens_of(camera)))


@njit(cache=True, error_model="numpy")
def _sums(pairs, T, lens, H, b):
    """Write the lower half of sum w J^T J to ``H`` and sum w J^T e to ``b``, for a twist of the query camera along its
    own axes, rotation first."""
    H[:], b[:] = 0.0, 0.0
    J, e = np.zeros((3, 6)), np.empty(3)
    for p in range(pairs.uv.shape[0]):
        d0, d1, d2 = pairs.xyz_R[p, 0] - T[0, 3], pairs.xyz_R[p, 1] - T[1, 3], pairs.xyz_R[p, 2] - T[2, 3]
        z = T[0, 2] * d0 + T[1, 2] * d1 + T[2, 2] * d2
        if not z > NEAREST_M:
            continue
        x = T[0, 0] * d0 + T[1, 0] * d1 + T[2, 0] * d2
        y = T[0, 1] * d0 + T[1, 1] * d1 + T[2, 1] * d2
        depth, sigma, scale = pairs.depth_m[p], pairs.sigma_px[p], 0.0
        if depth > 0.0:
            measured = DEPTH_SIGMA_PER_M * depth * depth
            known = DEPTH_SIGMA_PER_M * pairs.xyz_R[p, 2] * pairs.xyz_R[p, 2]
            slope = sigma * depth / lens.fx
            scale = 1.0 / max(np.sqrt(measured * measured + known * known + slope * slope), LEAST_DEPTH_SIGMA_M)
        u, v = lens.fx * x / z, lens.fy * y / z
        e[0], e[1] = (u + lens.cx - pairs.uv[p, 0]) / sigma, (v + lens.cy - pairs.uv[p, 1]) / sigma
        e[2] = (z - depth) * scale
        # The derivatives by y are (a, 0, c), (0, g, h) and (0, 0, scale); dy = [y]x dw - dv.
        a, c, g, h = lens.fx / (z * sigma), -u / (z * sigma), lens.fy / (z * sigma), -v / (z * sigma)
        J[0, 0], J[0, 1], J[0, 2], J[0, 3], J[0, 5] = -c * y, c * x - a * z, a * y, -a, -c
        J[1, 0], J[1, 1], J[1, 2], J[1, 4], J[1, 5] = g * z - h * y, h * x, -g * x, -g, -h
        J[2, 0], J[2, 1], J[2, 5] = -scale * y, scale * x, -scale
        for r in range(3):
            off = e[r] / CAUCHY
            weight = 1.0 / (1.0 + off * off)
            for i in range(6):
                b[i] += weight * J[r, i] * e[r]
                for j in range(i + 1):
                    H[i, j] += weight * J[r, i] * J[r, j]


@njit(cache=True, error_model="numpy")
def _fit(pairs, T, lens):
    """Move the pose T [4, 4] to where the pairs fit best; the matrix of the last step [6, 6]."""
    H, information, b, step, xi = np.empty((6, 6)), np.empty((6, 6)), np.empty(6), np.empty(6), np.empty(6)
    for _ in range(ROUNDS):
        _sums(pairs, T, lens, H, b)
        for i in range(6):
            H[i, i] += DAMPING
            b[i] = -b[i]
            for j in range(i + 1):
                information[i, j] = information[j, i] = H[i, j]
        solve_into(H, b, step)
        for i in range(3):  # along the axes of the reference
            xi[i] = T[i, 0] * step[3] + T[i, 1] * step[4] + T[i, 2] * step[5]
            xi[3 + i] = T[i, 0] * step[0] + T[i, 1] * step[1] + T[i, 2] * step[2]
        turn_about_camera(T, xi)
        if np.abs(step).max() < CONVERGED:
            break
    return information
