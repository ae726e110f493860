"""The image quadtree bottom-up: sums of the smallest cells that may be cut, added four by four,
then one walk down.

Sums are integers and the contrast is computed in the reference's order of operations, so the leaves
are the same.
"""

from typing import Literal

import numpy as np
import torch
from numba import int64, njit, prange
from torch import Tensor

from gsfusion_nb.seeding.quadtree import QUADTREE_NORMALISER, Cells
from gsfusion_nb.seeding.quadtree import quadtree as reference

from ..runtime.numba.launch import launching
from . import layout as col

_RED, _GREEN, _BLUE = col.LUMA_NUMERATORS
_DENOMINATOR = float(col.LUMA_DENOMINATOR)
_NORMALISER = float(QUADTREE_NORMALISER)

_SUM_RED, _SUM_GREEN, _SUM_BLUE, _SUM_SQUARES = range(4)
"""Sums over the pixels of a cell, int64: the channels, and their luma-weighted squares."""
_SUMS = 4
_N_COLUMNS = len(col.LEAF_COLUMNS)


def quadtree(
    rgb_u8: Tensor,
    *,
    threshold: float = 0.1,
    min_cell_px: int = 1,
    contrast: Literal["released", "std"] = "released",
) -> Cells:
    """See ``gsfusion_nb.seeding.quadtree``."""
    if rgb_u8.device.type != "cpu":
        return reference.reference(
            rgb_u8, threshold=threshold, min_cell_px=min_cell_px, contrast=contrast
        )
    image = rgb_u8.contiguous().numpy()
    height, width = image.shape[:2]
    levels = col.deepest_level(width, height, min_cell_px)
    with launching():
        xs = _lines(width, levels)
        ys = _lines(height, levels)
        split_flags = np.empty(0, np.uint8)
        if levels:
            sums = np.zeros((len(ys) // 2, len(xs) // 2, _SUMS), np.int64)
            _sums(image, xs[::2].copy(), ys[::2].copy(), sums)
            split_flags = _splits(
                sums, xs, ys, levels, float(threshold), int(min_cell_px), contrast == "released"
            )
        leaves = _leaves(split_flags, xs, ys, levels).copy()
    return col.to_cells(torch.from_numpy(leaves))


@njit(cache=True, error_model="numpy")
def _lines(length, levels):
    """Cell borders along one axis at the deepest level; every 2^k-th of them are the borders k
    levels higher."""
    n = 1 << levels
    lines = np.empty(n + 1, np.int64)
    lines[0] = 0
    lines[n] = length
    step = n
    while step > 1:
        for i in range(0, n, step):
            lines[i + step // 2] = lines[i] + (lines[i + step] - lines[i]) // 2
        step //= 2
    return lines


@njit(parallel=True, cache=True, error_model="numpy")
def _sums(image, xs, ys, sums):
    """Add R, G, B and the luma-weighted squares of each cell between the lines to ``sums`` [Y, X,
    _SUMS]."""
    rows = ys.shape[0] - 1
    columns = xs.shape[0] - 1
    width = image.shape[1]
    for task in prange(rows):
        i = int64(task)
        red = np.zeros(width, np.int32)
        green = np.zeros(width, np.int32)
        blue = np.zeros(width, np.int32)
        squares = np.zeros(width, np.int64)
        for y in range(ys[i], ys[i + 1]):
            line = image[y]
            for x in range(width):
                r = np.int32(line[x, 0])
                g = np.int32(line[x, 1])
                b = np.int32(line[x, 2])
                red[x] += r
                green[x] += g
                blue[x] += b
                squares[x] += (
                    np.int32(_RED) * r * r + np.int32(_GREEN) * g * g + np.int32(_BLUE) * b * b
                )
        for j in range(columns):
            for x in range(xs[j], xs[j + 1]):
                sums[i, j, _SUM_RED] += red[x]
                sums[i, j, _SUM_GREEN] += green[x]
                sums[i, j, _SUM_BLUE] += blue[x]
                sums[i, j, _SUM_SQUARES] += squares[x]


@njit(cache=True, error_model="numpy")
def _splits(sums, xs, ys, levels, threshold, min_cell_px, as_released):
    """Whether each cell would be cut, level after level from the whole image down; level l starts
    at (4^l - 1) / 3."""
    split_flags = np.empty(((1 << 2 * levels) - 1) // 3, np.uint8)
    pixels = xs[-1] * ys[-1]
    for level in range(levels - 1, -1, -1):
        n = 1 << level
        step = 1 << (levels - level)
        start = ((1 << 2 * level) - 1) // 3
        if level < levels - 1:
            sums = _parents(sums)
        for i in range(n):
            h = ys[(i + 1) * step] - ys[i * step]
            for j in range(n):
                w = xs[(j + 1) * step] - xs[j * step]
                area = float(h * w)
                r = sums[i, j, _SUM_RED] / area
                g = sums[i, j, _SUM_GREEN] / area
                b = sums[i, j, _SUM_BLUE] / area
                V = sums[i, j, _SUM_SQUARES] / area
                V = V - _RED * r * r
                V = V - _GREEN * g * g
                V = V - _BLUE * b * b
                V = max(V, 0.0) / _DENOMINATOR
                value = V * pixels / _NORMALISER if as_released else np.sqrt(V) / 255
                large = h // 2 > min_cell_px and w // 2 > min_cell_px
                split_flags[start + i * n + j] = large and value > threshold
    return split_flags


@njit(cache=True, error_model="numpy")
def _parents(sums):
    """The sums of the cells one level higher."""
    n = sums.shape[0] // 2
    parents = np.empty((n, n, _SUMS), np.int64)
    for i in range(n):
        for j in range(n):
            for c in range(_SUMS):
                top = sums[2 * i, 2 * j, c] + sums[2 * i, 2 * j + 1, c]
                parents[i, j, c] = top + sums[2 * i + 1, 2 * j, c] + sums[2 * i + 1, 2 * j + 1, c]
    return parents


@njit(cache=True, error_model="numpy")
def _leaves(split_flags, xs, ys, levels):
    """The leaves (``LEAF_COLUMNS``) in the reference's depth-first order."""
    leaves = np.empty((_N_COLUMNS, 1 << 2 * levels), np.int32)
    # level, row and column of cells still to be visited
    stack = np.empty((3 * levels + 4, 3), np.int64)
    stack[0, :] = 0
    top = 1
    count = 0
    while top:
        top -= 1
        level = stack[top, 0]
        i = stack[top, 1]
        j = stack[top, 2]
        start = ((1 << 2 * level) - 1) // 3
        if level < levels and split_flags[start + (i << level) + j]:
            for k in range(4):  # the last one pushed is the first one visited
                stack[top, 0] = level + 1
                stack[top, 1] = 2 * i + 1 - k % 2
                stack[top, 2] = 2 * j + 1 - k // 2
                top += 1
            continue
        step = 1 << (levels - level)
        leaves[col.X0, count] = xs[j * step]
        leaves[col.Y0, count] = ys[i * step]
        leaves[col.WIDTH, count] = xs[(j + 1) * step] - xs[j * step]
        leaves[col.HEIGHT, count] = ys[(i + 1) * step] - ys[i * step]
        leaves[col.LEVEL, count] = level
        count += 1
    return leaves[:, :count]
