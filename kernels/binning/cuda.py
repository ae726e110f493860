"""Lists of the splats that touch each tile, nearest first: ``binning.cu`` and torch's radix sorts.

Splats are sorted by depth once, the (splat, tile) pairs are listed in that order, and a stable sort by tile number
keeps it: two sorts with short keys. The number of pairs is the only value the host waits for.
"""

import torch
from torch import Tensor

from gsfusion_nb.types import Camera

from ..runtime.cuda.launch import launch, parts
from .tile_lists import TileLists, active_tiles, empty_pairs, sort_pairs

TILE = 16
"""Edge of a tile, pixels; as in ``splat.cuh``."""

_BLOCK = 128


def list_tiles(splats: Tensor, depth: Tensor, camera: Camera, pixels: Tensor | None) -> TileLists:
    """Lists of all splats with a finite depth; empty in tiles without any of ``pixels``."""
    device, N = splats.device, len(splats)
    tiles_x, tiles_y = parts(camera.width, TILE), parts(camera.height, TILE)
    active, before = (None, None) if pixels is None else active_tiles(pixels, TILE)
    size = (N, camera.width, camera.height, tiles_x)
    count = torch.empty(N, dtype=torch.int32, device=device)
    blocks = parts(N, _BLOCK)
    launch("render_forward", "binning:count_tiles", blocks, _BLOCK, splats, depth, before, count, *size)
    order = torch.sort(depth, stable=True).indices
    end = count.index_select(0, order).cumsum(0)  # int64
    total = int(end[-1]) if N else 0
    tile, ids = empty_pairs(total, tiles_x * tiles_y, device)
    keys = (tile, None) if tile.dtype == torch.int16 else (None, tile)
    launch("render_forward", "binning:list_tiles", blocks, _BLOCK, splats, order, end, count, active, *keys, ids, *size)
    return sort_pairs(tile, ids, tiles_x, tiles_y)
