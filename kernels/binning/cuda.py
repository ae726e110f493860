"""Lists of the splats that touch each tile, nearest first or in any order: ``binning.cu`` and
torch's radix sorts.

Splats are sorted by depth once, the (splat, tile) pairs are listed in that order, and a stable sort
by tile number keeps it: two sorts with short keys. The number of pairs is the only value the host
waits for.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsfusion_nb.types import Camera

from ..composite.layout import TILE
from ..runtime.arguments import parts
from ..runtime.cuda.launch import launch
from .layout import check_pairs

_BLOCK = 128
_SHORT_TILES = 1 << 15
"""An int16 numbers fewer tiles than this."""


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

    def work(
        self,
        splats: Tensor,
        camera: Camera,
        pixels: Tensor | None,
    ) -> dict[str, Any]:
        """What the kernels of ``square.cuh`` are given. ``pixels``: uint8, those to be drawn;
        ``None`` for all."""
        size = {"width": camera.width, "height": camera.height, "tiles_x": self.tiles_x}
        return size | {"splats": splats, "ids": self.ids, "offset": self.offset, "pixels": pixels}


def list_tiles(
    splats: Tensor,
    depth: Tensor,
    camera: Camera,
    pixels: Tensor | None,
    *,
    by_depth: bool = True,
) -> TileLists:
    """Lists of all splats with a finite depth; empty in tiles without any of ``pixels``.

    by_depth: nearest first; otherwise in the order of the map, which saves a sort.

    Raises:
        ValueError: there are more pairs than an int32 can number.
    """
    N = len(splats)
    device = splats.device
    tiles_x = parts(camera.width, TILE)
    grid = {"width": camera.width, "height": camera.height, "tiles_x": tiles_x}
    n_tiles = tiles_x * parts(camera.height, TILE)
    active, before = (None, None) if pixels is None else _active_tiles(pixels)
    count = torch.empty(N, dtype=torch.int32, device=device)
    blocks = parts(N, _BLOCK)
    launch(
        "render_forward",
        "binning:count_tiles",
        blocks,
        _BLOCK,
        splats,
        depth,
        before,
        count,
        N,
        grid,
    )
    order = torch.sort(depth, stable=True).indices if by_depth else torch.arange(N, device=device)
    end = count.index_select(0, order).cumsum(0)  # int64
    total = int(end[-1]) if N else 0
    check_pairs(total)
    short = n_tiles < _SHORT_TILES
    tile = torch.empty(total, dtype=torch.int16 if short else torch.int32, device=device)
    ids = torch.empty(total, dtype=torch.int32, device=device)
    pairs = {"order": order, "end": end, "count": count, "active": active, "ids": ids}
    pairs |= {"short_tile": tile if short else None, "tile": None if short else tile}
    launch("render_forward", "binning:list_tiles", blocks, _BLOCK, splats, pairs, N, grid)
    tile, place = torch.sort(tile, stable=True)
    numbers = torch.arange(n_tiles + 1, dtype=tile.dtype, device=device)
    offset = torch.searchsorted(tile, numbers, out_int32=True)
    return TileLists(
        ids=ids.index_select(0, place), offset=offset, tiles_x=tiles_x, n_tiles=n_tiles
    )


def _active_tiles(pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Whether each tile has a wanted pixel [tiles_y, tiles_x]; the number of those before each
    column of tiles, int32 [tiles_y, tiles_x + 1]."""
    H, W = pixels.shape
    padded = torch.nn.functional.pad(pixels, (0, -W % TILE, 0, -H % TILE))
    active = padded.unflatten(1, (-1, TILE)).unflatten(0, (-1, TILE)).any(3).any(1).contiguous()
    return active, torch.nn.functional.pad(active.cumsum(1, dtype=torch.int32), (1, 0)).contiguous()
