"""Lists of the splats that touch each tile, nearest first or in any order: ``binning.cu`` and torch's radix sorts.

Splats are sorted by depth once, the (splat, tile) pairs are listed in that order, and a stable sort by tile number
keeps it: two sorts with short keys. The number of pairs is the only value the host waits for.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gsfusion_nb.types import Camera

from ..runtime.arguments import parts
from ..runtime.cuda.launch import launch
from .layout import check_pairs

TILE = 16
"""Edge of a tile, pixels; as in ``splat.cuh``."""

_BLOCK = 128
_SHORT_TILES = 1 << 15
"""An int16 numbers fewer tiles than this."""


class Grid(NamedTuple):
    """Size of the image, and tiles in a row."""

    width: int
    height: int
    tiles_x: int


class Pairs(NamedTuple):
    """The (splat, tile) pairs that the kernel is to write, splat after splat in their order."""

    order: Tensor
    """int64 [N]: the splats in the order of each list."""
    end: Tensor
    """int64 [N]: in that order, one past each splat's last pair."""
    count: Tensor
    """int32 [N]: tiles of each splat."""
    active: Tensor | None
    """Which tiles are wanted; ``None`` for all."""
    short_tile: Tensor | None
    """int16 [I], to be written: the tile, where that numbers all tiles; else ``None``, and ``tile`` is written."""
    tile: Tensor | None
    """int32 [I]"""
    ids: Tensor
    """int32 [I], to be written: the splat."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TileLists:
    """One list of splats per tile: tile t has ``ids[offset[t] : offset[t + 1]]``."""

    ids: Tensor
    """int32 [I]"""
    offset: Tensor
    """int32 [tiles + 1]"""
    tiles_x: int
    """Tiles in a row."""
    n_tiles: int


def list_tiles(
    splats: Tensor, depth: Tensor, camera: Camera, pixels: Tensor | None, *, by_depth: bool = True
) -> TileLists:
    """Lists of all splats with a finite depth; empty in tiles without any of ``pixels``.

    by_depth: nearest first; otherwise in the order of the map, which saves a sort.

    Raises:
        ValueError: there are more pairs than an int32 can number.
    """
    N, device = len(splats), splats.device
    grid = Grid(width=camera.width, height=camera.height, tiles_x=parts(camera.width, TILE))
    n_tiles = grid.tiles_x * parts(camera.height, TILE)
    active, before = (None, None) if pixels is None else _active_tiles(pixels)
    count = torch.empty(N, dtype=torch.int32, device=device)
    blocks = parts(N, _BLOCK)
    launch("render_forward", "binning:count_tiles", blocks, _BLOCK, splats, depth, before, count, N, grid)
    order = torch.sort(depth, stable=True).indices if by_depth else torch.arange(N, device=device)
    end = count.index_select(0, order).cumsum(0)  # int64
    total = int(end[-1]) if N else 0
    check_pairs(total)
    short = n_tiles < _SHORT_TILES
    tile = torch.empty(total, dtype=torch.int16 if short else torch.int32, device=device)
    pairs = Pairs(
        order=order,
        end=end,
        count=count,
        active=active,
        short_tile=tile if short else None,
        tile=None if short else tile,
        ids=torch.empty(total, dtype=torch.int32, device=device),
    )
    launch("render_forward", "binning:list_tiles", blocks, _BLOCK, splats, pairs, N, grid)
    tile, place = torch.sort(tile, stable=True)
    numbers = torch.arange(n_tiles + 1, dtype=tile.dtype, device=device)
    offset = torch.searchsorted(tile, numbers, out_int32=True)
    return TileLists(ids=pairs.ids.index_select(0, place), offset=offset, tiles_x=grid.tiles_x, n_tiles=n_tiles)


def _active_tiles(pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Whether each tile has a wanted pixel [tiles_y, tiles_x]; the number of those before each column of tiles, int32
    [tiles_y, tiles_x + 1]."""
    H, W = pixels.shape
    padded = torch.nn.functional.pad(pixels, (0, -W % TILE, 0, -H % TILE))
    active = padded.unflatten(1, (-1, TILE)).unflatten(0, (-1, TILE)).any(3).any(1).contiguous()
    return active, torch.nn.functional.pad(active.cumsum(1, dtype=torch.int32), (1, 0)).contiguous()
