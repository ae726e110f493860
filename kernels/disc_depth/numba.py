"""Disc depth of each pixel's hit and its gradient: one pass over the pixels, one over the
Gaussians.

The formulas are those of ``gsfusion_nb.render.disc``. The gradient first lists the pixels of each
Gaussian by counting; then each Gaussian adds up its own, in the order of the image: the sums do not
depend on the number of threads.
"""

# Arrays are passed on as a list, which pyright cannot follow:
# pyright: reportCallIssue=false

import math
from typing import NamedTuple

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.render import disc as reference
from gsfusion_nb.render.constants import DISC_MAX_OFFSET, DISC_MIN_COSINE
from gsfusion_nb.types import Camera, GaussianParams

from ..runtime.arguments import lens_of
from ..runtime.numba.launch import launching
from ..runtime.numba.scalars import cyclic_size, cyclic_task

P_X, P_Y, P_Z, N_X, N_Y, N_Z, P_DOT_N, MAX_OFFSET_M, NORMAL_X, NORMAL_Y, NORMAL_Z = range(11)
"""A disc as a row of float32: centre p and normal n in the camera frame, p . n, the largest allowed
|z - p_z|, and the normal towards the camera in the world frame."""

DISC = 11
"""Numbers in a row."""

f32 = np.float32
_ZERO = f32(0.0)
_HALF = f32(0.5)
_ONE = f32(1.0)
_TWO = f32(2.0)
_CHUNK = 256
_ALL_ROWS = np.empty(0, np.bool_)


class PosedCamera(NamedTuple):
    """The camera and its pose, float32."""

    R_WC: np.ndarray
    centre_W: np.ndarray
    fx: np.float32
    fy: np.float32
    cx: np.float32
    cy: np.float32


class PixelLists(NamedTuple):
    """Pixels of an image, ``width`` a row, that hit Gaussian g: ``pixel[start[g] : start[g + 1]]``,
    in order."""

    pixel: np.ndarray
    start: np.ndarray
    width: int


def disc_depth(
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    hit_index: Tensor,
    *,
    max_offset: float | None = DISC_MAX_OFFSET,
    min_cosine: float = DISC_MIN_COSINE,
) -> reference.DiscDepth:
    """See ``gsfusion_nb.render.disc_depth``."""
    arrays = _arrays(params)
    view = _view(camera, T_WC)
    disc = hit_index.long().contiguous().numpy()
    depth = torch.empty(disc.shape)
    normal = torch.empty(*disc.shape, 3)
    on_plane = torch.empty(disc.shape, dtype=torch.bool)
    with launching():
        hit_rows = _rows_hit(disc.reshape(-1), len(params))
        discs = _list_discs(*arrays, view, _offset(max_offset), hit_rows)
        _meet_all(
            discs, disc, view, f32(min_cosine), depth.numpy(), normal.numpy(), on_plane.numpy()
        )
    return reference.DiscDepth(depth_m=depth, normal_W=normal, on_plane=on_plane)


def disc_depth_vjp(
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    hit_index: Tensor,
    v_depth_m: Tensor,
    *,
    max_offset: float | None = DISC_MAX_OFFSET,
    min_cosine: float = DISC_MIN_COSINE,
    rows: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """See ``gsfusion_nb.render.disc_depth_vjp``."""
    train_rows = _ALL_ROWS if rows is None else rows.contiguous().numpy()
    arrays = _arrays(params)
    view = _view(camera, T_WC)
    disc = hit_index.long().contiguous().numpy()
    v_depth = v_depth_m.detach().float().contiguous().numpy()
    v_xyz = torch.empty(len(params), 3)
    v_quat = torch.empty(len(params), 4)
    with launching():
        pixel, start = _pixels_by_row(
            disc.reshape(-1), v_depth.reshape(-1), len(params), train_rows
        )
        lists = PixelLists(pixel=pixel, start=start, width=disc.shape[1])
        discs = _list_discs(*arrays, view, _offset(max_offset), start[1:] > start[:-1])
        _meet_all_vjp(
            discs,
            *arrays[1:],
            lists,
            view,
            f32(min_cosine),
            v_depth.reshape(-1),
            v_xyz.numpy(),
            v_quat.numpy(),
        )
    return v_xyz, v_quat


def _arrays(params: GaussianParams) -> list[np.ndarray]:
    return [t.detach().contiguous().numpy() for t in (params.xyz_W, params.log_scale, params.quat)]


def _view(camera: Camera, T_WC: Tensor) -> PosedCamera:
    T = T_WC.detach().float().numpy()
    return PosedCamera(
        R_WC=T[:3, :3].copy(), centre_W=T[:3, 3].copy(), **lens_of(camera, f32)._asdict()
    )


def _offset(max_offset: float | None) -> np.float32:
    return f32(np.inf if max_offset is None else max_offset)


@njit(inline="always")
def _thin_axis(log_scale):
    """The axis of the smallest scale, the first of equals."""
    axis = 0
    for k in range(1, 3):
        if log_scale[k] < log_scale[axis]:
            axis = k
    return axis


@njit(inline="always")
def _unit(q):
    """|q| and the parts of q / |q|."""
    norm = max(math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), f32(1e-12))
    return norm, q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm


@njit(parallel=True, cache=True, error_model="numpy")
def _list_discs(xyz, log_scale, quat, view, max_offset, rows):
    """The discs [N, DISC]; those outside ``rows``, bool [N], stay empty."""
    N = xyz.shape[0]
    R = view.R_WC
    centre = view.centre_W
    discs = np.empty((N, DISC), np.float32)
    n_parts = (N + _CHUNK - 1) // _CHUNK
    for k_part in prange(cyclic_size(n_parts)):
        part = cyclic_task(k_part, n_parts)
        if part >= n_parts:
            continue
        for i in range(part * _CHUNK, min(N, part * _CHUNK + _CHUNK)):
            if not rows[i]:
                continue
            d = discs[i]
            _, w, x, y, z = _unit(quat[i])
            axis = _thin_axis(log_scale[i])
            if axis == 0:
                n0 = _ONE - _TWO * (y * y + z * z)
                n1 = _TWO * (x * y + w * z)
                n2 = _TWO * (x * z - w * y)
            elif axis == 1:
                n0 = _TWO * (x * y - w * z)
                n1 = _ONE - _TWO * (x * x + z * z)
                n2 = _TWO * (y * z + w * x)
            else:
                n0 = _TWO * (x * z + w * y)
                n1 = _TWO * (y * z - w * x)
                n2 = _ONE - _TWO * (x * x + y * y)
            p0 = xyz[i, 0] - centre[0]
            p1 = xyz[i, 1] - centre[1]
            p2 = xyz[i, 2] - centre[2]
            for k in range(3):
                d[P_X + k] = R[0, k] * p0 + R[1, k] * p1 + R[2, k] * p2
                d[N_X + k] = R[0, k] * n0 + R[1, k] * n1 + R[2, k] * n2
            d[P_DOT_N] = d[P_X] * d[N_X] + d[P_Y] * d[N_Y] + d[P_Z] * d[N_Z]
            d[MAX_OFFSET_M] = max_offset * math.exp(
                max(log_scale[i, 0], log_scale[i, 1], log_scale[i, 2])
            )
            side = -_ONE if d[P_DOT_N] > _ZERO else _ONE
            d[NORMAL_X] = side * n0
            d[NORMAL_Y] = side * n1
            d[NORMAL_Z] = side * n2
    return discs


@njit(inline="always")
def _meet(disc, x, y, min_cosine):
    """z, r . n and whether z is on the plane, for the ray (x, y, 1)."""
    rn = x * disc[N_X] + y * disc[N_Y] + disc[N_Z]
    if abs(rn) >= min_cosine * math.sqrt(x * x + y * y + _ONE):
        z = disc[P_DOT_N] / rn
        if z > _ZERO and abs(z - disc[P_Z]) <= disc[MAX_OFFSET_M]:
            return z, rn, True
    return disc[P_Z], rn, False


@njit(parallel=True, cache=True, error_model="numpy")
def _meet_all(discs, disc, view, min_cosine, depth, normal, on_plane):
    """The three images; every pixel is written."""
    H, W = disc.shape
    for j in prange(H):
        y = (f32(j) + _HALF - view.cy) / view.fy
        for i in range(W):
            depth[j, i] = _ZERO
            on_plane[j, i] = False
            normal[j, i, 0] = _ZERO
            normal[j, i, 1] = _ZERO
            normal[j, i, 2] = _ZERO
            if disc[j, i] < 0:
                continue
            d = discs[disc[j, i]]
            x = (f32(i) + _HALF - view.cx) / view.fx
            depth[j, i], _, on_plane[j, i] = _meet(d, x, y, min_cosine)
            normal[j, i, 0] = d[NORMAL_X]
            normal[j, i, 1] = d[NORMAL_Y]
            normal[j, i, 2] = d[NORMAL_Z]


@njit(cache=True, error_model="numpy")
def _rows_hit(disc, N):
    """Which rows some pixel hits. [N]"""
    is_hit = np.zeros(N, np.bool_)
    for g in disc:
        if g >= 0:
            is_hit[g] = True
    return is_hit


@njit(cache=True, error_model="numpy")
def _pixels_by_row(disc, v_depth, N, train_rows):
    """Places in the image of the pixels that hit row g and whose depth has a gradient, in order:
    ``pixel[start[g] : start[g + 1]]``.

    Rows outside ``train_rows`` have none; an empty array stands for all rows.
    """
    start = np.zeros(N + 1, np.int32)
    all_wanted = train_rows.shape[0] == 0
    for o in range(disc.shape[0]):
        g = disc[o]
        if g >= 0 and v_depth[o] != _ZERO and (all_wanted or train_rows[g]):
            start[g + 1] += 1
    for g in range(N):
        start[g + 1] += start[g]
    cursor = start[:-1].copy()
    pixel = np.empty(start[N], np.int32)
    for o in range(disc.shape[0]):
        g = disc[o]
        if g >= 0 and v_depth[o] != _ZERO and (all_wanted or train_rows[g]):
            pixel[cursor[g]] = o
            cursor[g] += 1
    return pixel, start


@njit(parallel=True, cache=True, error_model="numpy")
def _meet_all_vjp(discs, log_scale, quat, lists, view, min_cosine, v_depth, v_xyz, v_quat):
    """Each row's sum over its pixels, in float64, carried to centre and quaternion; every row is
    written."""
    pixel = lists.pixel
    start = lists.start
    width = lists.width
    R = view.R_WC
    N = discs.shape[0]
    n_parts = (N + _CHUNK - 1) // _CHUNK
    for k_part in prange(cyclic_size(n_parts)):
        part = cyclic_task(k_part, n_parts)
        if part >= n_parts:
            continue
        v_p = np.empty(3)
        v_n = np.empty(3)
        e = np.empty(3)
        for i in range(part * _CHUNK, min(N, part * _CHUNK + _CHUNK)):
            v_xyz[i] = _ZERO
            v_quat[i] = _ZERO
            if start[i] == start[i + 1]:
                continue
            d = discs[i]
            at_centre = 0.0
            at_plane = 0.0
            n0 = 0.0
            n1 = 0.0
            n2 = 0.0
            for k in range(start[i], start[i + 1]):
                o = pixel[k]
                x = (f32(o % width) + _HALF - view.cx) / view.fx
                y = (f32(o // width) + _HALF - view.cy) / view.fy
                z, rn, on_plane = _meet(d, x, y, min_cosine)
                if on_plane:
                    v = v_depth[o] / rn
                    at_plane += v
                    n0 += v * (d[P_X] - z * x)
                    n1 += v * (d[P_Y] - z * y)
                    n2 += v * (d[P_Z] - z)
                else:
                    at_centre += v_depth[o]
            for k in range(3):  # to the world frame: v_p = at_plane n + at_centre (0, 0, 1)
                a = R[k, 0]
                b = R[k, 1]
                c = R[k, 2]
                v_p[k] = at_plane * (a * d[N_X] + b * d[N_Y] + c * d[N_Z]) + at_centre * c
                v_n[k] = a * n0 + b * n1 + c * n2
                v_xyz[i, k] = v_p[k]
            e[:] = 0.0
            e[_thin_axis(log_scale[i])] = 1.0
            _axis_vjp(quat[i], e, v_n, v_quat[i])


@njit(cache=True, error_model="numpy")
def _axis_vjp(quat, e, v, v_quat):
    """Gradient ``v`` of the axis R(q) e, carried to the quaternion."""
    norm, w, x, y, z = _unit(quat)
    ue = x * e[0] + y * e[1] + z * e[2]
    uv = x * v[0] + y * v[1] + z * v[2]
    ev = e[0] * v[0] + e[1] * v[1] + e[2] * v[2]
    c0 = y * e[2] - z * e[1]
    c1 = z * e[0] - x * e[2]
    c2 = x * e[1] - y * e[0]
    v_w = 2.0 * (w * ev + v[0] * c0 + v[1] * c1 + v[2] * c2)
    v_x = 2.0 * (ue * v[0] + uv * e[0] - ev * x + w * (e[1] * v[2] - e[2] * v[1]))
    v_y = 2.0 * (ue * v[1] + uv * e[1] - ev * y + w * (e[2] * v[0] - e[0] * v[2]))
    v_z = 2.0 * (ue * v[2] + uv * e[2] - ev * z + w * (e[0] * v[1] - e[1] * v[0]))
    radial = w * v_w + x * v_x + y * v_y + z * v_z
    v_quat[0] = (v_w - w * radial) / norm
    v_quat[1] = (v_x - x * radial) / norm
    v_quat[2] = (v_y - y * radial) / norm
    v_quat[3] = (v_z - z * radial) / norm
