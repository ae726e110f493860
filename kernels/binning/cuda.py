"""Lists of the splats that touch each tile, nearest first: ``binning.cu`` and torch's radix sorts."""

from typing import NamedTuple

import torch
from torch import Tensor

from gsfusion_nb.types import Camera

from ..runtime.cuda.launch import launch
from ..runtime.gpu import parts
from . import host
from .host import TileGrid, TileLists, active_tiles

TILE = 16
"""Edge of a tile, pixels; as in ``splat.cuh``."""

_BLOCK = 128


class Grid(NamedTuple):
    """Size of the image, and tiles in a row."""

    width: int
    height: int
    tiles_x: int


class Pairs(NamedTuple):
    """``host.Pairs``, with which tiles are wanted (``None``: all) and one of two arrays of tiles."""

    order: Tensor
    end: Tensor
    count: Tensor
    active: Tensor | None
    short_tile: Tensor | None
    tile: Tensor | None
    ids: Tensor


def list_tiles(splats: Tensor, depth: Tensor, camera: Camera, pixels: Tensor | None) -> TileLists:
    """Lists of all splats with a finite depth; empty in tiles without any of ``pixels``."""
    N = len(splats)
    active, before = (None, None) if pixels is None else active_tiles(pixels, TILE)
    tiles = TileGrid(width=camera.width, height=camera.height, edge=TILE)
    grid = Grid(width=tiles.width, height=tiles.height, tiles_x=tiles.tiles_x)

    def count_tiles(count: Tensor) -> None:
        kernel = "binning:count_tiles"
        launch("render_forward", kernel, parts(N, _BLOCK), _BLOCK, splats, depth, before, count, N, grid)

    def write_pairs(pairs: host.Pairs) -> None:
        short = pairs.tile.dtype == torch.int16
        to_write = Pairs(
            order=pairs.order,
            end=pairs.end,
            count=pairs.count,
            active=active,
            short_tile=pairs.tile if short else None,
            tile=None if short else pairs.tile,
            ids=pairs.ids,
        )
        launch("render_forward", "binning:list_tiles", parts(N, _BLOCK), _BLOCK, splats, to_write, N, grid)

    return host.list_tiles(depth, tiles, count_tiles, write_pairs)
