"""The image quadtree from integral images, one level of the tree at a time.

Where an interval is cut depends only on the interval, so the cells of one level lie on a fixed grid of lines. The
integral images are therefore kept only where those lines cross.

What the kernels share: the luma weights as whole numbers, the depth of the tree, and the columns of its leaves.
"""

from typing import Literal

import torch
from torch import Tensor

from gsfusion_nb.seeding.quadtree import LUMA_WEIGHTS, QUADTREE_NORMALISER, Cells

LUMA_DENOMINATOR = 10_000
LUMA_NUMERATORS = tuple(round(w * LUMA_DENOMINATOR) for w in LUMA_WEIGHTS)
"""The luma weights as whole numbers, so that sums over pixels stay exact integers."""

LEAF_COLUMNS = X0, Y0, WIDTH, HEIGHT, LEVEL = range(5)
"""Rows of an array of leaves [5, n]: first column and row of pixels, size, level."""


def deepest_level(width: int, height: int, min_cell_px: int) -> int:
    """Level at which not even the largest cell may be cut. The largest of level l is ceil(size / 2^l)."""
    level = 0
    while width // 2 > min_cell_px and height // 2 > min_cell_px:
        width, height, level = (width + 1) // 2, (height + 1) // 2, level + 1
    return level


def to_cells(leaves: Tensor) -> Cells:
    """The leaves from an array of theirs [5, n]."""
    return Cells(x0=leaves[X0], y0=leaves[Y0], width=leaves[WIDTH], height=leaves[HEIGHT], level=leaves[LEVEL])


def quadtree(
    rgb_u8: Tensor,
    *,
    threshold: float = 0.1,
    min_cell_px: int = 1,
    contrast: Literal["released", "std"] = "released",
) -> Cells:
    """See ``gsfusion_nb.seeding.quadtree``."""
    H, W = rgb_u8.shape[:2]
    finest = deepest_level(W, H, min_cell_px)
    xs, ys = (_grid_lines(n, finest).to(rgb_u8.device) for n in (W, H))
    corners = _integral_image(rgb_u8, xs, ys)
    order = _bits_apart(finest).to(rgb_u8.device)
    parts, keys = [], []
    alive = torch.ones((1, 1), dtype=torch.bool, device=rgb_u8.device)
    for level in range(finest + 1):
        step = 1 << (finest - level)
        x, y = xs[::step], ys[::step]
        w, h = x.diff(), y.diff()
        if level < finest:
            V = _variance(corners[:, ::step, ::step], w, h)
            value = V * (H * W) / QUADTREE_NORMALISER if contrast == "released" else V.sqrt() / 255
            large = (h // 2 > min_cell_px)[:, None] & (w // 2 > min_cell_px)[None, :]
            split = alive & large & (value > threshold)
        else:
            split = torch.zeros_like(alive)
        iy, ix = (alive & ~split).nonzero(as_tuple=True)
        parts.append((x[ix], y[iy], w[ix], h[iy], torch.full_like(ix, level)))
        keys.append(2 * order[ix * step] + order[iy * step])
        alive = _children(split)
    depth_first = torch.cat(keys).argsort()
    columns = (torch.cat(c)[depth_first].to(torch.int32) for c in zip(*parts, strict=True))
    x0, y0, width, height, depth = columns
    return Cells(x0=x0, y0=y0, width=width, height=height, level=depth)


def _grid_lines(length: int, levels: int) -> Tensor:
    """Cell borders along one axis at the deepest level; every 2^k-th of them are the borders k levels higher."""
    lines = torch.tensor([0, length])
    for _ in range(levels):
        middle = lines[:-1] + lines.diff() // 2
        lines = torch.cat([torch.stack([lines[:-1], middle], dim=1).flatten(), lines[-1:]])
    return lines


def _integral_image(rgb_u8: Tensor, xs: Tensor, ys: Tensor) -> Tensor:
    """Sums over all pixels left of and above each crossing of lines: R, G, B, luma-weighted squares. [4, Gy, Gx]"""
    r, g, b = rgb_u8.to(torch.int32).unbind(-1)
    wr, wg, wb = LUMA_NUMERATORS
    squares = wr * r * r + wg * g * g + wb * b * b  # at most 9999 * 255^2 = 6.5e8, inside int32
    band = torch.repeat_interleave(ys.diff())
    column = torch.repeat_interleave(xs.diff())
    sums = torch.zeros((4, len(ys) - 1, rgb_u8.shape[1]), dtype=torch.int64, device=rgb_u8.device)
    for channel, plane in enumerate((r, g, b, squares)):
        sums[channel].index_add_(0, band, plane.long())
    cells = torch.zeros((len(xs) - 1, 4, len(ys) - 1), dtype=torch.int64, device=rgb_u8.device)
    cells.index_add_(0, column, sums.permute(2, 0, 1))
    table = cells.permute(1, 2, 0).cumsum(1).cumsum(2)
    return torch.nn.functional.pad(table, (1, 0, 1, 0))


def _variance(corners: Tensor, w: Tensor, h: Tensor) -> Tensor:
    """Luma-weighted population variance of every cell of one level, on 0..255: sum_c w_c (E[c^2] - E[c]^2). [Y, X]"""
    sums = corners.diff(dim=1).diff(dim=2)
    mean = sums.double() / (h[:, None] * w[None, :])
    *means, V = mean
    for weight, m in zip(LUMA_NUMERATORS, means, strict=True):
        V = V - weight * m * m
    return V.clamp_min(0.0) / LUMA_DENOMINATOR


def _children(split: Tensor) -> Tensor:
    """The cells of the next level whose parent was cut."""
    return split.repeat_interleave(2, dim=0).repeat_interleave(2, dim=1)


def _bits_apart(levels: int) -> Tensor:
    """Each index below 2^levels with a zero between its bits; two such numbers interleave to the depth-first rank."""
    index = torch.arange(1 << levels)
    spread = torch.zeros_like(index)
    for bit in range(levels):
        spread |= ((index >> bit) & 1) << (2 * bit)
    return spread
