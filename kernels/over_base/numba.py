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
from ..composite.numba import HALF, ONE, ZERO, across, alpha_of, row_exponent, zeros
from ..project.gradients import gradients_of
from ..project.layout import (
    BLUE,
    DEPTH,
    GREEN,
    RED,
    V,
    pack_camera,
)
from ..project.numba import project
from ..runtime.numba.launch import launching, scratch
from ..runtime.numba.scalars import cyclic_size, cyclic_task
from ..runtime.numba.simd import (
    LANES,
    any_lane,
    load,
    splat,
    store,
)
from .bands import BAND, column_range, list_bands, row_range, stride_of
from .gradients import PLANES, gradient_planes, splat_sums

f32 = np.float32
_INFINITE = f32(np.inf)


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
