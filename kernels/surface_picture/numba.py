"""``surface_picture`` in one pass over the pixels: fill what is unknown through a pyramid, then
enlarge."""

import numpy as np
import torch
from numba import int64, njit, prange
from torch import Tensor

from gsfusion_nb.render.over_base import Base
from gsfusion_nb.render.surface_picture import SAME_SURFACE, SurfacePicture
from gsfusion_nb.render.surface_picture import surface_picture as reference

from ..runtime.numba.launch import launching

f32 = np.float32
_ZERO = f32(0.0)
_HALF = f32(0.5)
_ONE = f32(1.0)
_THREE = f32(3.0)
_NINE = f32(9.0)
_SAME = f32(SAME_SURFACE)

_DEPTH = 3
"""Channel of the depth, behind the colours."""


def surface_picture(
    rgb: Tensor, depth_m: Tensor, size: tuple[int, int], holes: str, behind_m: float
) -> SurfacePicture:
    """See ``gsfusion_nb.render.surface_picture``."""
    if rgb.dtype != torch.float32:
        return reference.reference(rgb, depth_m, size, holes, behind_m)
    image = np.concatenate([rgb.numpy(), depth_m.numpy()[..., None]], axis=2)
    has_depth = image[..., _DEPTH] > 0
    planes = [torch.empty(*size, *n) for n in ((3,), (), (), ())]
    with launching():
        if not has_depth.all():
            _fill(image, has_depth)
        arrays = tuple(x.numpy() for x in planes)
        _write(
            image, has_depth, depth_m.shape == size, holes == "filled", holes == "gaussians", arrays
        )
    colour, depth, weight, dense_depth = planes
    return SurfacePicture(
        base=Base(rgb=colour, depth_m=depth, weight=weight),
        depth_everywhere_m=dense_depth,
        behind_m=behind_m,
    )


@njit(cache=True, error_model="numpy")
def _fill(image, has_depth):
    """Fill ``image`` in place where it is not known; see ``base_image.fill``."""
    height, width = has_depth.shape
    if max(height, width) == 1:
        image[:] = _ZERO
        return
    h = (height + 1) // 2
    w = (width + 1) // 2
    small = np.zeros((h, w, 4), np.float32)
    has_value = np.zeros((h, w), np.bool_)
    complete = True
    for i in range(h):
        for j in range(w):
            n = _ZERO
            for y in range(2 * i, min(2 * i + 2, height)):
                for x in range(2 * j, min(2 * j + 2, width)):
                    if has_depth[y, x]:
                        n += _ONE
                        for c in range(4):
                            small[i, j, c] += image[y, x, c]
            has_value[i, j] = n > _ZERO
            complete = complete and has_value[i, j]
            for c in range(4):
                small[i, j, c] /= max(n, _ONE)
    if not complete:
        _fill(small, has_value)
    scale_y = f32(h) / f32(height)
    scale_x = f32(w) / f32(width)
    for y in range(height):
        for x in range(width):
            if not has_depth[y, x]:
                v = max((f32(y) + _HALF) * scale_y - _HALF, _ZERO)
                u = max((f32(x) + _HALF) * scale_x - _HALF, _ZERO)
                i = min(int(v), h - 1)
                j = min(int(u), w - 1)
                k = min(i + 1, h - 1)
                m = min(j + 1, w - 1)
                b = v - f32(i)
                a = u - f32(j)
                for c in range(4):
                    upper = small[i, j, c] * (_ONE - a) + small[i, m, c] * a
                    lower = small[k, j, c] * (_ONE - a) + small[k, m, c] * a
                    image[y, x, c] = upper * (_ONE - b) + lower * b


@njit(parallel=True, cache=True, error_model="numpy")
def _write(image, has_depth, same_size, fill, weightless, planes):
    """Fill the four pictures from the filled one, of the same size or of half of it."""
    colour, depth, weight, dense_depth = planes
    height, width = depth.shape
    for row in prange(height):
        y = int64(row)
        value = np.empty(4, np.float32)
        for x in range(width):
            i, j = (y, x) if same_size else (y // 2, x // 2)
            if same_size:
                value[:] = image[y, x]
            else:
                _mean_around(image, has_depth, y, x, value)
            is_measured = has_depth[i, j]
            dense_depth[y, x] = value[_DEPTH]
            depth[y, x] = value[_DEPTH] if is_measured else _ZERO
            weight[y, x] = _ONE if is_measured or not weightless else _ZERO
            for c in range(3):
                colour[y, x, c] = value[c] if is_measured or fill else _ZERO


@njit(cache=True, error_model="numpy")
def _mean_around(image, has_depth, y, x, value):
    """The value of a large pixel: see ``base_image.enlarge``."""
    h, w = has_depth.shape
    i = y // 2
    j = x // 2
    row = min(max(i + 2 * (y % 2) - 1, 0), h - 1)
    side = min(max(j + 2 * (x % 2) - 1, 0), w - 1)
    z = image[i, j, _DEPTH]
    total = _NINE
    for c in range(4):
        value[c] = _NINE * image[i, j, c]
    for k in range(3):
        a, b, share = (
            (row, j, _THREE) if k == 0 else (i, side, _THREE) if k == 1 else (row, side, _ONE)
        )
        if abs(image[a, b, _DEPTH] - z) < _SAME * z and has_depth[a, b] == has_depth[i, j]:
            total += share
            for c in range(4):
                value[c] += share * image[a, b, c]
    for c in range(4):
        value[c] /= total
