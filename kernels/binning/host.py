"""Lists of the splats that touch each tile, on a GPU: what Triton and CUDA have in common around their kernels.

Splats are sorted by depth once, the (splat, tile) pairs are listed in that order, and a stable sort by tile number
keeps it: two sorts with short keys. The number of pairs is the only value the host waits for.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ..runtime.gpu import parts

_SHORT_TILES = 1 << 15

MOST_PAIRS = 1 << 31
"""Kernels number pairs with 32 bits."""


class TileGrid(NamedTuple):
    """An image cut into tiles of ``edge`` x ``edge`` pixels."""

    width: int
    height: int
    edge: int

    @property
    def tiles_x(self) -> int:
        """Tiles in a row."""
        return parts(self.width, self.edge)

    @property
    def tiles_y(self) -> int:
        """Rows of tiles."""
        return parts(self.height, self.edge)

    @property
    def n_tiles(self) -> int:
        """All tiles."""
        return self.tiles_x * self.tiles_y


@dataclass(frozen=True, kw_only=True, eq=False)
class TileLists:
    """One list of splats per tile: tile t has ``ids[offset[t] : offset[t + 1]]``."""

    ids: Tensor
    """int32 [I]"""
    offset: Tensor
    """int32 [tiles + 1]"""
    grid: TileGrid


class Pairs(NamedTuple):
    """The (splat, tile) pairs that a kernel is to write, splat after splat in the order of depth."""

    order: Tensor
    """int64 [N]: the splats, nearest first."""
    count: Tensor
    """int32 [N]: tiles of each splat."""
    ordered_count: Tensor
    """int32 [N]: the same in that order."""
    end: Tensor
    """int64 [N]: in that order, one past each splat's last pair."""
    tile: Tensor
    """[I], to be written: int16 where that numbers all tiles, else int32."""
    ids: Tensor
    """int32 [I], to be written: the splat."""


def list_tiles(
    depth: Tensor, grid: TileGrid, count_tiles: Callable[[Tensor], None], write_pairs: Callable[[Pairs], None]
) -> TileLists:
    """The lists of all tiles, nearest first.

    Args:
        depth: Of each splat, infinite for those that are not drawn. [N]
        grid: The tiles.
        count_tiles: Writes the number of tiles of each splat to an int32 [N].
        write_pairs: Writes tile and splat of each pair.

    Raises:
        ValueError: there are more pairs than an int32 can number.
    """
    count = torch.empty(len(depth), dtype=torch.int32, device=depth.device)
    count_tiles(count)
    order = torch.sort(depth, stable=True).indices
    ordered_count = count.index_select(0, order)
    end = ordered_count.cumsum(0)  # int64
    total = int(end[-1]) if len(depth) else 0
    check_pairs(total)
    number = torch.int16 if grid.n_tiles < _SHORT_TILES else torch.int32
    tile, ids = (torch.empty(total, dtype=dtype, device=depth.device) for dtype in (number, torch.int32))
    write_pairs(Pairs(order=order, count=count, ordered_count=ordered_count, end=end, tile=tile, ids=ids))
    tile, place = torch.sort(tile, stable=True)
    numbers = torch.arange(grid.n_tiles + 1, dtype=tile.dtype, device=tile.device)
    offset = torch.searchsorted(tile, numbers, out_int32=True)
    return TileLists(ids=ids.index_select(0, place), offset=offset, grid=grid)


def active_tiles(pixels: Tensor, edge: int) -> tuple[Tensor, Tensor]:
    """Whether each tile has a wanted pixel [tiles_y, tiles_x]; the number of those before each column of tiles, int32
    [tiles_y, tiles_x + 1]."""
    H, W = pixels.shape
    padded = torch.nn.functional.pad(pixels, (0, -W % edge, 0, -H % edge))
    active = padded.unflatten(1, (-1, edge)).unflatten(0, (-1, edge)).any(3).any(1).contiguous()
    return active, torch.nn.functional.pad(active.cumsum(1, dtype=torch.int32), (1, 0)).contiguous()


def check_pairs(total: int) -> None:
    """Raise ``ValueError`` if there are more (Gaussian, tile) pairs than kernels can number."""
    if total >= MOST_PAIRS:
        raise ValueError(
            f"render_forward: {total} (Gaussian, tile) pairs are more than 2^31; draw a smaller image, "
            "or a map of smaller Gaussians"
        )
