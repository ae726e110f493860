"""Lists of the splats that touch each tile, from (splat, tile) pairs on a GPU; kernels find the pairs."""

from dataclasses import dataclass

import torch
from torch import Tensor

_SHORT_TILES = 1 << 15


@dataclass(frozen=True, kw_only=True, eq=False)
class TileLists:
    """One list of splats per tile: tile t has ``ids[offset[t] : offset[t + 1]]``."""

    ids: Tensor  # int32 [I]
    offset: Tensor  # int32 [tiles + 1]
    tiles_x: int
    tiles_y: int

    @property
    def n_tiles(self) -> int:
        return self.tiles_x * self.tiles_y


def active_tiles(pixels: Tensor, edge: int) -> tuple[Tensor, Tensor]:
    """Whether each tile has a wanted pixel [tiles_y, tiles_x]; the number of those before each column of tiles, int32
    [tiles_y, tiles_x + 1]."""
    H, W = pixels.shape
    padded = torch.nn.functional.pad(pixels, (0, -W % edge, 0, -H % edge))
    active = padded.unflatten(1, (-1, edge)).unflatten(0, (-1, edge)).any(3).any(1).contiguous()
    return active, torch.nn.functional.pad(active.cumsum(1, dtype=torch.int32), (1, 0)).contiguous()


def empty_pairs(total: int, n_tiles: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Room for the tile, int16 where that numbers them all, and the splat, int32, of each pair.

    Raises:
        ValueError: there are more pairs than an int32 can number.
    """
    if total >= 1 << 31:
        raise ValueError(f"render_forward: {total} (Gaussian, tile) pairs are more than 2^31; draw a smaller image")
    tile = torch.empty(total, dtype=torch.int16 if n_tiles < _SHORT_TILES else torch.int32, device=device)
    return tile, torch.empty(total, dtype=torch.int32, device=device)


def sort_pairs(tile: Tensor, ids: Tensor, tiles_x: int, tiles_y: int) -> TileLists:
    """The lists of all tiles; in each, pairs keep their order."""
    tile, place = torch.sort(tile, stable=True)
    numbers = torch.arange(tiles_x * tiles_y + 1, dtype=tile.dtype, device=tile.device)
    offset = torch.searchsorted(tile, numbers, out_int32=True)
    return TileLists(ids=ids.index_select(0, place), offset=offset, tiles_x=tiles_x, tiles_y=tiles_y)
