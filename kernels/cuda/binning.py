"""Lists of the splats that touch each tile, nearest first: ``binning.cu`` and torch's radix sorts.

Splats are sorted by depth once, the (splat, tile) pairs are listed in that order, and a stable sort by tile number
keeps it: two sorts with short keys. The number of pairs is the only value the host waits for.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from gsfusion_nb.types import Camera

from .launch import launch, parts

TILE = 16
"""Edge of a tile, pixels; as in ``splat.cuh``."""

_BLOCK = 128
_SHORT_TILES = 1 << 15


@dataclass(frozen=True, kw_only=True, eq=False)
class TileLists:
    """One list of splats per tile: tile t has ``ids[offset[t] : offset[t + 1]]``."""

    ids: Tensor  # int32 [I]
    offset: Tensor  # int32 [tiles + 1]
    tiles_x: int
    tiles_y: int


def list_tiles(splats: Tensor, depth: Tensor, camera: Camera, pixels: Tensor | None) -> TileLists:
    """Lists of all splats with a finite depth; empty in tiles without any of ``pixels``."""
    device, N = splats.device, len(splats)
    tiles_x, tiles_y = parts(camera.width, TILE), parts(camera.height, TILE)
    active, before = (None, None) if pixels is None else _wanted(pixels)
    size = (N, camera.width, camera.height, tiles_x)
    count = torch.empty(N, dtype=torch.int32, device=device)
    blocks = parts(N, _BLOCK)
    launch("render_forward", "binning:count_tiles", blocks, _BLOCK, splats, depth, before, count, *size)
    order = torch.sort(depth, stable=True).indices
    end = count.index_select(0, order).cumsum(0)  # int64
    total = int(end[-1]) if N else 0
    if total >= 1 << 31:
        raise ValueError(f"render_forward: {total} (Gaussian, tile) pairs are more than 2^31; draw a smaller image")
    short = tiles_x * tiles_y < _SHORT_TILES
    tile = torch.empty(total, dtype=torch.int16 if short else torch.int32, device=device)
    ids = torch.empty(total, dtype=torch.int32, device=device)
    keys = (tile, None) if short else (None, tile)
    launch("render_forward", "binning:list_tiles", blocks, _BLOCK, splats, order, end, count, active, *keys, ids, *size)
    tile, place = torch.sort(tile, stable=True)
    numbers = torch.arange(tiles_x * tiles_y + 1, dtype=tile.dtype, device=device)
    return TileLists(
        ids=ids.index_select(0, place),
        offset=torch.searchsorted(tile, numbers, out_int32=True),
        tiles_x=tiles_x,
        tiles_y=tiles_y,
    )


def _wanted(pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Tiles with a wanted pixel, uint8 [tiles_y, tiles_x]; their number before each column [tiles_y, tiles_x + 1]."""
    H, W = pixels.shape
    padded = torch.nn.functional.pad(pixels, (0, -W % TILE, 0, -H % TILE))
    active = padded.unflatten(1, (-1, TILE)).unflatten(0, (-1, TILE)).any(3).any(1)
    before = torch.nn.functional.pad(active.cumsum(1, dtype=torch.int32), (1, 0))
    return active.contiguous().view(torch.uint8), before.contiguous()
