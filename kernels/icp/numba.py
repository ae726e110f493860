"""Normal equations of point-to-plane ICP in one pass over the pixels of a frame.

The formulas are those of ``gsfusion_nb.tracking.icp``. Each row of pixels first lists
its correspondences, sqrt(w) [J, r, 1] in columns, then multiplies them: 29 vectorised dot products.
Rows are added up in order, so the sums do not depend on the number of threads.
"""

# Arrays are passed on as tuples, which pyright cannot follow:
# pyright: reportCallIssue=false

from typing import NamedTuple

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.tracking.icp_system import IcpSystem
from gsfusion_nb.tracking.icp_system import icp_system as reference
from gsfusion_nb.tracking.surface import DepthLevel, Surface

from ..runtime.arguments import lens_of
from ..runtime.numba.launch import launching
from .host import H_ROWS, INLIERS, N_SUMS, OVERLAP, SQUARES, WEIGHTS, B, images_of, to_system

f32 = np.float32
_N_X, _N_Y, _N_Z, _M_X, _M_Y, _M_Z, _RESIDUAL, _WEIGHT = range(8)
"""Columns of a correspondence: the six of J, the normal and the moment of it about the origin, then
r and 1."""
_N_COLUMNS = 8
_ZERO = f32(0.0)
_HALF = f32(0.5)
_ONE = f32(1.0)


class Poses(NamedTuple):
    """T_WC about the centre of the surface's camera [4, 4]; rotation of that camera [3, 3].
    float32"""

    T_WC: np.ndarray
    R_WS: np.ndarray


def icp_system(
    level: DepthLevel,
    T_WC: Tensor,
    surface: Surface,
    *,
    max_distance_m: float,
    min_cosine: float,
    even_to_m: float | None = None,
) -> IcpSystem:
    """See ``gsfusion_nb.tracking.icp_system``."""
    images = images_of(level, surface).values()
    if any(t.dtype != torch.float32 or t.device.type != "cpu" for t in images):
        options = {
            "max_distance_m": max_distance_m,
            "min_cosine": min_cosine,
            "even_to_m": even_to_m,
        }
        return reference.reference(level, T_WC, surface, **options)
    depth, normal, surface_depth, surface_normal = (t.detach().contiguous().numpy() for t in images)
    poses = poses_of(T_WC, surface.T_WC)
    max_square_m2 = f32(max_distance_m) * f32(max_distance_m)
    even = f32(np.inf if even_to_m is None else even_to_m)
    gates = max_square_m2, f32(min_cosine), even
    frame = (depth, normal)
    model = (surface_depth, surface_normal)
    with launching():
        sums = _sum_rows(
            frame, model, poses, lens_of(level.camera, f32), lens_of(surface.camera, f32), gates
        )
    return to_system(torch.from_numpy(sums.sum(0)))


def poses_of(T_WC: Tensor, T_WS: Tensor) -> Poses:
    """As ``about_the_surface``, in a tenth of its time."""
    surface = T_WS.detach().double().cpu().numpy()
    T = T_WC.detach().double().cpu().numpy().copy()
    T[:3, 3] -= surface[:3, 3]
    return Poses(T_WC=T.astype(np.float32), R_WS=surface[:3, :3].astype(np.float32))


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def dot(a, b, n):
    """float64 sum, in an order that lets the compiler use whole vectors."""
    total = 0.0
    for i in range(n):
        total += np.float64(a[i]) * np.float64(b[i])
    return total


@njit(cache=True, error_model="numpy")
def _correspond(frame, model, poses, lens, surface_lens, gates, j, columns):
    """Write sqrt(w) [J, r, 1] of the correspondences of row j to ``columns``; their number, and
    that of the overlap.

    frame, model: depth [H, W] and normals [H, W, 3] of the frame, and of the surface that it is
    aligned with. gates: the largest square of a distance, the least cosine, and the depth up to
    which all have the same weight.
    """
    depth, normal = frame
    surface_depth, surface_normal = model
    max_square_m2, min_cosine, even_to_m = gates
    T = poses.T_WC
    R = poses.R_WS
    height, width = surface_depth.shape
    fx = surface_lens.fx
    fy = surface_lens.fy
    cx = surface_lens.cx
    cy = surface_lens.cy
    y = (f32(j) + _HALF - lens.cy) / lens.fy
    n_inliers = 0
    n_overlap = 0
    for i in range(depth.shape[1]):
        z = depth[j, i]
        if not z > _ZERO:
            continue
        x = (f32(i) + _HALF - lens.cx) / lens.fx
        X = z * x
        Y = z * y
        p0 = T[0, 0] * X + T[0, 1] * Y + T[0, 2] * z + T[0, 3]
        p1 = T[1, 0] * X + T[1, 1] * Y + T[1, 2] * z + T[1, 3]
        p2 = T[2, 0] * X + T[2, 1] * Y + T[2, 2] * z + T[2, 3]
        s2 = R[0, 2] * p0 + R[1, 2] * p1 + R[2, 2] * p2
        if not s2 > _ZERO:
            continue
        u = fx * ((R[0, 0] * p0 + R[1, 0] * p1 + R[2, 0] * p2) / s2) + cx
        v = fy * ((R[0, 1] * p0 + R[1, 1] * p1 + R[2, 1] * p2) / s2) + cy
        if not (u >= _ZERO and u < f32(width) and v >= _ZERO and v < f32(height)):
            continue
        column = int(u)
        row = int(v)
        d = surface_depth[row, column]
        n0 = surface_normal[row, column, 0]
        n1 = surface_normal[row, column, 1]
        n2 = surface_normal[row, column, 2]
        if not d > _ZERO or (n0 == _ZERO and n1 == _ZERO and n2 == _ZERO):
            continue
        n_overlap += 1
        X = d * ((f32(column) + _HALF - cx) / fx)
        Y = d * ((f32(row) + _HALF - cy) / fy)
        e0 = p0 - (R[0, 0] * X + R[0, 1] * Y + R[0, 2] * d)
        e1 = p1 - (R[1, 0] * X + R[1, 1] * Y + R[1, 2] * d)
        e2 = p2 - (R[2, 0] * X + R[2, 1] * Y + R[2, 2] * d)
        if not e0 * e0 + e1 * e1 + e2 * e2 <= max_square_m2:
            continue
        a = normal[j, i, 0]
        b = normal[j, i, 1]
        c = normal[j, i, 2]
        cosine = (
            n0 * (T[0, 0] * a + T[0, 1] * b + T[0, 2] * c)
            + n1 * (T[1, 0] * a + T[1, 1] * b + T[1, 2] * c)
            + n2 * (T[2, 0] * a + T[2, 1] * b + T[2, 2] * c)
        )
        if not cosine >= min_cosine:
            continue
        depth_ratio = even_to_m / z
        # the square root of the weight, on both factors of each product
        w = depth_ratio * depth_ratio if depth_ratio < _ONE else _ONE
        k = n_inliers
        columns[_RESIDUAL, k] = w * (e0 * n0 + e1 * n1 + e2 * n2)
        columns[_WEIGHT, k] = w
        n0 = w * n0
        n1 = w * n1
        n2 = w * n2
        columns[_N_X, k] = n0
        columns[_N_Y, k] = n1
        columns[_N_Z, k] = n2
        columns[_M_X, k] = p1 * n2 - p2 * n1
        columns[_M_Y, k] = p2 * n0 - p0 * n2
        columns[_M_Z, k] = p0 * n1 - p1 * n0
        n_inliers += 1
    return n_inliers, n_overlap


@njit(parallel=True, cache=True, error_model="numpy")
def _sum_rows(frame, model, poses, lens, surface_lens, gates):
    """The sums of ``host.to_system`` for each row of pixels [H, N_SUMS]."""
    height, width = frame[0].shape
    sums = np.empty((height, N_SUMS))
    for j in prange(height):
        columns = np.empty((_N_COLUMNS, width), np.float32)
        n, sums[j, OVERLAP] = _correspond(
            frame, model, poses, lens, surface_lens, gates, j, columns
        )
        sums[j, INLIERS] = n
        for a in range(6):
            for b in range(a, 6):
                sums[j, H_ROWS[a] + b - a] = dot(columns[a], columns[b], n)
        for a in range(6):
            sums[j, B + a] = dot(columns[a], columns[_RESIDUAL], n)
        sums[j, SQUARES] = dot(columns[_RESIDUAL], columns[_RESIDUAL], n)
        sums[j, WEIGHTS] = dot(columns[_WEIGHT], columns[_WEIGHT], n)
    return sums
