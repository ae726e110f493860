"""``render_over_base`` and its gradient, what ``gsfusion_nb.backends`` offers for CPU tensors.

Project and colour every row, then sum up over bands of image rows, sixteen pixels a vector; nothing
is sorted. A plane holds one number for each pixel, row by row. Its rows are a vector longer than
the image's, so that sixteen lanes may begin at any pixel.

What a pixel gives to every splat over it are four numbers, q and -q . C, so the gradient finishes
one splat after another, whatever its place among the others. Its sums go through the gradient of
the projection, as in ``rasterize``. float64 runs on the reference.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.backends import Record
from gsfusion_nb.render.constants import NEAR_PLANE_M
from gsfusion_nb.render.over_base import Base, OverBaseOutput
from gsfusion_nb.types import Camera, GaussianParams

from ..binning.numba import tile_windows
from ..composite import layout as pair
from ..composite.numba import CEILING, HALF, ONE, ZERO, across, alpha_of, row_exponent, zeros
from ..project.layout import (
    BLUE,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    DEPTH,
    EXTENT_U,
    EXTENT_V,
    GREEN,
    RED,
    U,
    V,
    pack_camera,
)
from ..project.numba import gradients_of, project
from ..runtime.numba.launch import launching, scratch
from ..runtime.numba.scalars import cyclic_size, cyclic_task
from ..runtime.numba.simd import (
    LANES,
    any_lane,
    exp,
    load,
    minimum,
    negative_abs,
    reduce_add,
    select,
    splat,
    store,
)

f32 = np.float32
_INFINITE = f32(np.inf)

BAND = 8
"""Rows of a band."""


class BandLists(NamedTuple):
    """The splats that touch each band: band b has ``ids[offset[b] : offset[b + 1]]``, in the order
    of the map."""

    ids: np.ndarray
    offset: np.ndarray


class Surface(NamedTuple):
    """The base: colour [H, W, 3], depth and weight [H, W]. float32"""

    rgb: np.ndarray
    depth: np.ndarray
    weight: np.ndarray


class Blended(NamedTuple):
    """What is made of it: colour [H, W, 3], depth [H, W] and the sum of weights [H, W]. float32"""

    rgb: np.ndarray
    depth: np.ndarray
    weight: np.ndarray


@njit(inline="always", cache=True)
def stride_of(width):
    """Length of a row of a plane."""
    return (width + 2 * LANES - 1) // LANES * LANES


@njit(inline="always")
def row_range(s, y0, y1):
    """Rows from ``y0`` to before ``y1`` that splat ``s`` reaches: the first, and the one behind the
    last."""
    return max(y0, int(np.ceil(s[V] - s[EXTENT_V] - HALF))), min(
        y1, int(np.floor(s[V] + s[EXTENT_V] - HALF)) + 1
    )


@njit(inline="always")
def column_range(s, width):
    """The same for columns of the image."""
    return max(0, int(np.ceil(s[U] - s[EXTENT_U] - HALF))), min(
        width, int(np.floor(s[U] + s[EXTENT_U] - HALF)) + 1
    )


@njit(cache=True, error_model="numpy")
def list_bands(splats, start, height):
    """The splats of each band; row i is drawn where ``start[i] < start[i + 1]``."""
    n_bands = (height + BAND - 1) // BAND
    offset = np.zeros(n_bands + 1, np.int32)
    for i in range(splats.shape[0]):
        if start[i] < start[i + 1]:
            first, end = row_range(splats[i], 0, height)
            for band in range(first // BAND, (end + BAND - 1) // BAND):
                offset[band + 1] += 1
    for band in range(n_bands):
        offset[band + 1] += offset[band]
    ids = np.empty(offset[n_bands], np.int32)
    cursor = offset[:-1].copy()
    for i in range(splats.shape[0]):
        if start[i] < start[i + 1]:
            first, end = row_range(splats[i], 0, height)
            for band in range(first // BAND, (end + BAND - 1) // BAND):
                ids[cursor[band]] = i
                cursor[band] += 1
    return BandLists(ids, offset)


_RED, _GREEN, _BLUE, _WEIGHT, _LIMIT, _DEPTH = range(6)
"""Planes of a band: sums of w c and of w, the depth behind which a splat is hidden, and the sum of
w z."""


@njit(parallel=True, cache=True, error_model="numpy")
def blend_bands(splats, lists, base, behind, image):
    """Fill ``image`` from the splats and the base. behind: of the surface, where splats are hidden,
    metres."""
    n_bands = lists.offset.shape[0] - 1
    for k_band in prange(cyclic_size(n_bands)):
        band = cyclic_task(k_band, n_bands)
        if band < n_bands:
            _blend_band(band, splats, lists, base, behind, image)


@njit(cache=True, error_model="numpy")
def _blend_band(band, splats, lists, base, behind, image):
    """Fill the rows of one band."""
    height, width = image.weight.shape
    stride = stride_of(width)
    plane = BAND * stride
    y0 = band * BAND
    y1 = min(height, band * BAND + BAND)
    state = zeros(6 * plane)
    for y in range(y0, y1):
        at = _LIMIT * plane + (y - y0) * stride
        for x in range(width):
            D = base.depth[y, x]
            state[at + x] = D + behind if D > ZERO else _INFINITE
    for k in range(lists.offset[band], lists.offset[band + 1]):
        _add(state, splats[lists.ids[k]], (y0, y1, width), (plane, stride))
    for y in range(y0, y1):
        _write_row(state, (y - y0) * stride, plane, y, base, image)


@njit(inline="always")
def _add(state, s, place, layout):
    """Add the weights of a splat, times its colour and depth, to the planes of the band at
    ``place``."""
    y0, y1, width = place
    plane, stride = layout
    first, end = row_range(s, y0, y1)
    left, right = column_range(s, width)
    red = splat(s[RED])
    green = splat(s[GREEN])
    blue = splat(s[BLUE])
    z = splat(s[DEPTH])
    for x in range(left, right, LANES):
        _, q0, q1 = across(s, x)
        for y in range(first, end):
            log_alpha, seen = row_exponent(s, q0, q1, f32(y) + HALF - s[V])
            o = (y - y0) * stride + x
            seen = seen & (load(state, _LIMIT * plane + o) >= z)
            if not any_lane(seen):
                continue
            w = alpha_of(log_alpha, seen)
            store(state, o, load(state, o) + w * red)
            store(state, _GREEN * plane + o, load(state, _GREEN * plane + o) + w * green)
            store(state, _BLUE * plane + o, load(state, _BLUE * plane + o) + w * blue)
            store(state, _WEIGHT * plane + o, load(state, _WEIGHT * plane + o) + w)
            store(state, _DEPTH * plane + o, load(state, _DEPTH * plane + o) + w * z)


@njit(cache=True, error_model="numpy")
def _write_row(state, o, plane, y, base, image):
    """One row of the picture from the sums that begin at ``o``."""
    for x in range(image.weight.shape[1]):
        W = state[_WEIGHT * plane + o + x]
        b = base.weight[y, x]
        D = base.depth[y, x]
        image.weight[y, x] = W
        total = ONE / (b + W) if b + W > ZERO else ZERO
        image.rgb[y, x, 0] = (b * base.rgb[y, x, 0] + state[o + x]) * total
        image.rgb[y, x, 1] = (b * base.rgb[y, x, 1] + state[_GREEN * plane + o + x]) * total
        image.rgb[y, x, 2] = (b * base.rgb[y, x, 2] + state[_BLUE * plane + o + x]) * total
        has_base = ONE if D > ZERO else ZERO
        total = ONE / (has_base + W) if has_base + W > ZERO else ZERO
        image.depth[y, x] = ((D if D > ZERO else ZERO) + state[_DEPTH * plane + o + x]) * total


Q_RED, Q_GREEN, Q_BLUE, MINUS_QC, LIMIT = range(5)
"""Planes: dL/d of the sum of w c, minus its product with the picture, and where splats are
hidden."""
PLANES = 5

_CHUNK = 64
"""Splats that one thread takes at a time."""


@njit(parallel=True, cache=True, error_model="numpy")
def gradient_planes(image, base, behind, v_rgb, planes):
    """Fill ``planes`` [PLANES, H, stride]; zero beyond the image."""
    height, width = image.weight.shape
    for y in prange(height):
        planes[:, y, width:] = ZERO
        for x in range(width):
            total = base.weight[y, x] + image.weight[y, x]
            D = base.depth[y, x]
            per = ONE / total if total > ZERO else ZERO
            red = v_rgb[y, x, 0] * per
            green = v_rgb[y, x, 1] * per
            blue = v_rgb[y, x, 2] * per
            planes[Q_RED, y, x] = red
            planes[Q_GREEN, y, x] = green
            planes[Q_BLUE, y, x] = blue
            qC = red * image.rgb[y, x, 0] + green * image.rgb[y, x, 1] + blue * image.rgb[y, x, 2]
            planes[MINUS_QC, y, x] = -qC
            planes[LIMIT, y, x] = D + behind if D > ZERO else _INFINITE


@njit(parallel=True, cache=True, error_model="numpy")
def splat_sums(splats, visible_rows, train_rows, planes, size, sums, abs_sums):
    """Write the sums of each drawn splat to its row of ``sums`` [M, PAIR_SUMS].

    visible_rows: the rows of the map that are drawn. train_rows: bool [N], or [0] for all; the sums
    of others are not written. planes: one after another, flat. abs_sums: [M, 2], for the sums of
    |dL/du| and |dL/dv|, or None.
    """
    height, width = size
    all_trained = train_rows.shape[0] == 0
    M = visible_rows.shape[0]
    n_parts = (M + _CHUNK - 1) // _CHUNK
    for k_part in prange(cyclic_size(n_parts)):
        part = cyclic_task(k_part, n_parts)
        if part >= n_parts:
            continue
        for m in range(part * _CHUNK, min(M, part * _CHUNK + _CHUNK)):
            if all_trained or train_rows[visible_rows[m]]:
                sums[m] = ZERO
                if abs_sums is not None:
                    abs_sums[m] = ZERO
                _add_up(splats[visible_rows[m]], planes, height, width, sums[m], abs_sums, m)


@njit(inline="always")
def _add_up(s, planes, height, width, row_sums, abs_sums, m):
    """Add the sums over the pixels of a splat to ``row_sums`` and to row ``m`` of ``abs_sums``."""
    first, end = row_range(s, 0, height)
    left, right = column_range(s, width)
    stride = stride_of(width)
    plane = height * stride
    red = splat(s[RED])
    green = splat(s[GREEN])
    blue = splat(s[BLUE])
    z = splat(s[DEPTH])
    zero = splat(ZERO)
    for x in range(left, right, LANES):
        dx, q0, q1 = across(s, x)
        sum_g = zero
        sum_gy = zero
        sum_gyy = zero
        sum_r = zero
        sum_gr = zero
        sum_b = zero
        minus_u = zero
        minus_v = zero
        for y in range(first, end):
            dy = f32(y) + HALF - s[V]
            log_alpha, seen = row_exponent(s, q0, q1, dy)
            o = y * stride + x
            seen = seen & (load(planes, LIMIT * plane + o) >= z)
            if not any_lane(seen):
                continue
            raw = exp(log_alpha)
            w = select(seen, minimum(raw, splat(CEILING)), zero)
            q_r = load(planes, o)
            q_g = load(planes, Q_GREEN * plane + o)
            q_b = load(planes, Q_BLUE * plane + o)
            v_w = red * q_r + green * q_g + blue * q_b + load(planes, MINUS_QC * plane + o)
            g = select(seen & (raw < splat(CEILING)), v_w * w, zero)
            gy = g * splat(dy)
            sum_g = sum_g + g
            sum_gy = sum_gy + gy
            sum_gyy = sum_gyy + gy * splat(dy)
            sum_r = sum_r + w * q_r
            sum_gr = sum_gr + w * q_g
            sum_b = sum_b + w * q_b
            if abs_sums is not None:
                minus_u = minus_u + negative_abs(
                    g * (splat(s[CONIC_A]) * dx + splat(s[CONIC_B] * dy))
                )
                minus_v = minus_v + negative_abs(
                    g * (splat(s[CONIC_B]) * dx + splat(s[CONIC_C] * dy))
                )
        gx = sum_g * dx
        row_sums[pair.SUM_GX] += reduce_add(gx)
        row_sums[pair.SUM_GY] += reduce_add(sum_gy)
        row_sums[pair.SUM_GXX] += reduce_add(gx * dx)
        row_sums[pair.SUM_GXY] += reduce_add(sum_gy * dx)
        row_sums[pair.SUM_GYY] += reduce_add(sum_gyy)
        row_sums[pair.SUM_G] += reduce_add(sum_g)
        row_sums[pair.SUM_RED] += reduce_add(sum_r)
        row_sums[pair.SUM_GREEN] += reduce_add(sum_gr)
        row_sums[pair.SUM_BLUE] += reduce_add(sum_b)
        if abs_sums is not None:
            abs_sums[m, 0] -= reduce_add(minus_u)
            abs_sums[m, 1] -= reduce_add(minus_v)
    row_sums[pair.SUM_DEPTH] = ZERO


_ALL_PIXELS = np.empty((0, 0), np.bool_)
_ALL_ROWS = np.empty(0, np.bool_)


@dataclass(frozen=True, kw_only=True, eq=False)
class NumbaSaved(Record):
    """What the backward pass needs of the forward one."""

    backend = "numba"
    params: GaussianParams
    camera: Camera
    base: Base
    behind_m: float
    lens: np.ndarray
    splats: np.ndarray
    start: np.ndarray
    """Row i is drawn where ``start[i] < start[i + 1]``; its sums are then in row ``start[i]``."""
    image: Blended


def render_over_base(
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    base: Base,
    *,
    behind_m: float,
    near_m: float = NEAR_PLANE_M,
) -> tuple[OverBaseOutput, Any]:
    """See ``gsfusion_nb.render.render_over_base``."""
    cam = pack_camera(camera, T_WC, near_m)
    N = len(params)
    H = camera.height
    W = camera.width
    rgb, depth_m, weight = (torch.empty(H, W, *n) for n in ((3,), (), ()))
    image = Blended(rgb.numpy(), depth_m.numpy(), weight.numpy())
    with launching():
        splats, count, _ = project(params, cam, tile_windows(_ALL_PIXELS, W, H))
        start = np.zeros(N + 1, np.int32)
        np.cumsum(count > 0, out=start[1:])
        blend_bands(
            splats, list_bands(splats, start, H), _surface(base), np.float32(behind_m), image
        )
    saved = NumbaSaved(
        params=params,
        camera=camera,
        base=base,
        behind_m=behind_m,
        lens=cam,
        splats=splats,
        start=start,
        image=image,
    )
    return OverBaseOutput(rgb=rgb, depth_m=depth_m, weight=weight), saved


def render_over_base_vjp(
    saved: Any,
    v_rgb: Tensor,
    *,
    rows: Tensor | None = None,
    v_uv: Tensor | None = None,
    v_uv_abs: Tensor | None = None,
) -> GaussianParams:
    """See ``gsfusion_nb.render.render_over_base_vjp``."""
    train_rows = _ALL_ROWS if rows is None else rows.contiguous().numpy()
    H, W = saved.image.weight.shape
    visible_rows = np.flatnonzero(np.diff(saved.start)).astype(np.int32)
    stride = stride_of(W)
    with launching():
        planes = scratch("base_planes", PLANES * H * stride)
        sums = scratch("splat_sums", len(visible_rows) * pair.PAIR_SUMS).reshape(-1, pair.PAIR_SUMS)
        abs_sums = (
            None if v_uv_abs is None else scratch("abs_sums", len(visible_rows) * 2).reshape(-1, 2)
        )
        v_image = v_rgb.contiguous().numpy()
        behind = np.float32(saved.behind_m)
        gradient_planes(
            saved.image, _surface(saved.base), behind, v_image, planes.reshape(PLANES, H, stride)
        )
        splat_sums(saved.splats, visible_rows, train_rows, planes, (H, W), sums, abs_sums)
        return gradients_of(saved, train_rows, sums, abs_sums, v_uv, v_uv_abs)


def _surface(base: Base) -> Surface:
    return Surface(
        *(image.detach().contiguous().numpy() for image in (base.rgb, base.depth_m, base.weight))
    )
