"""Lists of the splats that touch each tile, nearest first: count, sum up, list, sort by tile.

A splat's tiles are those of the reference, ``render.tiles``: the ellipse alpha = 1/255, cut by each row of tiles.
"""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportIndexIssue=false

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsfusion_nb.constants import ALPHA_MIN
from gsfusion_nb.types import Camera

from ..composite.triton import TILE
from ..project.triton import CONIC_A, CONIC_B, CONIC_C, EXTENT_U, EXTENT_V, LN_OPACITY, SPLAT, U, V
from ..runtime.triton.launch import launch, parts
from . import host
from .host import Pairs, TileGrid, TileLists, active_tiles

_BLOCK = 128
_LOG_ALPHA_MIN = tl.constexpr(math.log(ALPHA_MIN))
_SLACK = tl.constexpr(1e-2)


def list_tiles(splats: Tensor, depth: Tensor, camera: Camera, pixels: Tensor | None) -> TileLists:
    """Lists of all splats with a finite depth; empty in tiles without any of ``pixels``."""
    grid = TileGrid(width=camera.width, height=camera.height, edge=TILE)
    rank, column = (splats, splats) if pixels is None else _active_columns(pixels)
    shared = {
        "splats": splats,
        "rank": rank,
        "width": grid.width,
        "height": grid.height,
        "tiles_x": grid.tiles_x,
        "MASKED": pixels is not None,
        "TILE": TILE,
        "BLOCK": _BLOCK,
        "num_warps": 4,
    }

    def count_tiles(count: Tensor) -> None:
        N = len(splats)
        launch(_count, parts(N, _BLOCK), splats.device, depth=depth, count=count, N=N, **shared)

    def write_pairs(pairs: Pairs) -> None:
        total = len(pairs.ids)
        launch(
            _list,
            parts(total, _BLOCK),
            splats.device,
            nth=torch.repeat_interleave(pairs.ordered_count, output_size=total),
            order=pairs.order,
            end=pairs.end,
            count=pairs.count,
            column=column,
            tile=pairs.tile,
            ids=pairs.ids,
            total=total,
            n_tiles=grid.n_tiles,
            **shared,
        )

    return host.list_tiles(depth, grid, count_tiles, write_pairs)


def _active_columns(pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Of the tiles with a wanted pixel: how many stand before each column [tiles_y, tiles_x + 1]; their columns."""
    active, rank = active_tiles(pixels, TILE)
    column = active.to(torch.uint8).sort(dim=1, descending=True, stable=True).indices.to(torch.int32)
    return rank, column.contiguous()


@triton.jit
def _tile_range(low, high, size, TILE: tl.constexpr):
    """First tile, and one past the last, with a pixel centre i + 0.5 between ``low`` and ``high``."""
    top = size + 0.0
    first = tl.minimum(tl.maximum(tl.ceil(low - 0.5 - _SLACK), 0.0), top)
    end = tl.minimum(tl.maximum(tl.floor(high - 0.5 + _SLACK) + 1.0, 0.0), top)
    first_tile = first.to(tl.int32) // TILE
    end_tile = (end.to(tl.int32) + TILE - 1) // TILE
    return first_tile, tl.where(end > first, end_tile, first_tile)


@triton.jit
def _columns(u, v, e_u, e_v, A, B, C, ln_o, ty, width, TILE: tl.constexpr):
    """First tile, and one past the last, that the ellipse alpha = 1/255 meets in a row of tiles."""
    top = ty * TILE + 0.5 - v
    bottom = top + (TILE - 1)
    dy_right = tl.minimum(tl.maximum(-B / C * e_u, top), bottom)
    dy_left = tl.minimum(tl.maximum(B / C * e_u, top), bottom)
    h = tl.sqrt(2.0 * tl.maximum(ln_o - _LOG_ALPHA_MIN, 0.0) / A)
    e_v = tl.maximum(e_v, 1e-20)
    p, q = dy_right / e_v, dy_left / e_v
    right = u - B / A * dy_right + h * tl.sqrt(tl.maximum(1.0 - p * p, 0.0))
    left = u - B / A * dy_left - h * tl.sqrt(tl.maximum(1.0 - q * q, 0.0))
    return _tile_range(left, right, width, TILE)


@triton.jit
def _load_ellipse(splats, g, mask):
    """Centre, extents, conic and ln(opacity) of splats."""
    s = splats + g * SPLAT
    return (
        tl.load(s + U, mask=mask, other=0.0),
        tl.load(s + V, mask=mask, other=0.0),
        tl.load(s + EXTENT_U, mask=mask, other=0.0),
        tl.load(s + EXTENT_V, mask=mask, other=0.0),
        tl.load(s + CONIC_A, mask=mask, other=1.0),
        tl.load(s + CONIC_B, mask=mask, other=0.0),
        tl.load(s + CONIC_C, mask=mask, other=1.0),
        tl.load(s + LN_OPACITY, mask=mask, other=0.0),
    )


@triton.jit(do_not_specialize=["N", "width", "height", "tiles_x"])
def _count(
    splats, depth, rank, count, N, width, height, tiles_x,
    MASKED: tl.constexpr, TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row = i < N
    drawn = tl.load(depth + i, mask=row, other=float("inf")) < float("inf")
    u, v, e_u, e_v, A, B, C, ln_o = _load_ellipse(splats, i, drawn)
    y0, y1 = _tile_range(v - e_v, v + e_v, height, TILE)
    rows = tl.where(drawn, y1 - y0, 0)
    n = tl.zeros([BLOCK], tl.int32)
    j, most = 0, tl.max(rows, axis=0)
    while j < most:
        x0, x1 = _columns(u, v, e_u, e_v, A, B, C, ln_o, y0 + j, width, TILE)
        on = j < rows
        if MASKED:
            line = rank + (y0 + j) * (tiles_x + 1)
            x0, x1 = tl.load(line + x0, mask=on, other=0), tl.load(line + x1, mask=on, other=0)
        n += tl.where(on, x1 - x0, 0)
        j += 1
    tl.store(count + i, n, mask=row)


@triton.jit(do_not_specialize=["total", "n_tiles", "width", "height", "tiles_x"])
def _list(
    splats, nth, order, end, count, rank, column, tile, ids, total, n_tiles, width, height, tiles_x,
    MASKED: tl.constexpr, TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Tile of each pair: walk the rows of its splat until the pair's number among the splat's is reached.

    A pair that is not found goes to no tile: it would take a compiler that rounds here otherwise than in ``_count``.
    """
    pair = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = pair < total
    at = tl.load(nth + pair, mask=here, other=0)
    g = tl.load(order + at, mask=here, other=0).to(tl.int32)
    left = pair - (tl.load(end + at, mask=here, other=0).to(tl.int32) - tl.load(count + g, mask=here, other=0))
    u, v, e_u, e_v, A, B, C, ln_o = _load_ellipse(splats, g, here)
    ty, y1 = _tile_range(v - e_v, v + e_v, height, TILE)
    found = tl.zeros([BLOCK], tl.int32) + n_tiles
    active = here & (ty < y1)
    while tl.max(active.to(tl.int32), axis=0) > 0:
        x0, x1 = _columns(u, v, e_u, e_v, A, B, C, ln_o, ty, width, TILE)
        if MASKED:
            line = rank + ty * (tiles_x + 1)
            x0, x1 = tl.load(line + x0, mask=active, other=0), tl.load(line + x1, mask=active, other=0)
        inside = active & (left < x1 - x0)
        x = x0 + left
        if MASKED:
            x = tl.load(column + ty * tiles_x + x, mask=inside, other=0)
        found = tl.where(inside, ty * tiles_x + x, found)
        left -= x1 - x0
        ty += 1
        active = active & (inside == 0) & (ty < y1)
    tl.store(tile + pair, found, mask=here)
    tl.store(ids + pair, g, mask=here)
