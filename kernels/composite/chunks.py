"""How the work is cut: chunks of list entries whose arrays stay in the cache, and images cut into tiles.

A chunk is ``RANKS`` consecutive entries of the lists of ``TILES`` tiles: arrays [K, n, P], P pixels a tile. Tiles are
taken in the order of their list length, so that little of a chunk is filler. Chunks come in rounds: the first ``RANKS``
entries of all tiles, then the next of those tiles which have any left and where some pixel still has light.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gsfusion_nb.constants import TRANSMITTANCE_MIN
from gsfusion_nb.render.tiles import TileLists
from gsfusion_nb.types import Camera

RANKS = 32
"""List entries per chunk: an opaque tile is noticed after at most this many more."""
TILES = 128
"""Tiles per chunk: 32 x 128 x 64 float32 are a MiB, about a core's second-level cache."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Chunk:
    """K consecutive entries of the lists of n tiles, and the light that reaches them."""

    tile: Int[Tensor, " n"]
    entry: Int[Tensor, "K n"]
    """Place in the lists; one past the end where a list is shorter."""
    first_rank: int
    """Place of the first of them in its tile's list."""
    T: Float[Tensor, "n P"]
    """Transmittance in front of the first of them."""


NO_HIT = -1
"""In place of a row: no opaque Gaussian yet."""


def cut_into_chunks(
    tiles: TileLists, T: Float[Tensor, "tiles P"], hit: Int[Tensor, "tiles P"] | None = None
) -> Iterator[Chunk]:
    """All list entries that can be seen or hit, in rounds, nearest first.

    ``T`` is read before each chunk is handed out: the caller writes there what the chunk lets through; likewise
    ``hit``, where pixels that still look for an opaque Gaussian hold ``NO_HIT``.
    """
    begin, length = tiles.offset[:-1].long(), tiles.offset.diff().long()
    alive = length.argsort(descending=True, stable=True)
    for first_rank in range(0, int(length.max()), RANKS):
        lit = T.index_select(0, alive).amax(1) >= TRANSMITTANCE_MIN
        if hit is not None:
            lit = lit | (hit.index_select(0, alive) == NO_HIT).any(1)
        alive = alive[lit & (length[alive] > first_rank)]
        for tile in alive.split(TILES) if len(alive) else ():
            left = length[tile] - first_rank
            rank = torch.arange(min(RANKS, int(left[0])), device=tile.device)[:, None]
            entry = torch.where(rank < left, begin[tile] + first_rank + rank, len(tiles.gaussian))
            yield Chunk(tile=tile, entry=entry, first_rank=first_rank, T=T.index_select(0, tile))


class Scratch:
    """Arrays that every chunk uses again: getting fresh megabytes from the system costs more than filling them."""

    def __init__(self, like: Tensor):
        self._like = like
        self._flat: dict[str, Tensor] = {}

    def __call__(self, name: str, *shape: int) -> Tensor:
        """The array ``name`` in this shape; what it holds is what was last written there."""
        numel = math.prod(shape)
        flat = self._flat.get(name)
        if flat is None or len(flat) < numel:
            flat = self._flat[name] = self._like.new_empty(numel)
        return flat[:numel].view(shape)


def image_to_tiles(image: Float[Tensor, "H W C"], tiles: TileLists) -> Float[Tensor, "tiles C P"]:
    """Pixels by tile, zero beyond the border."""
    H, W, C = image.shape
    P = tiles.tile_px
    padded = image.new_zeros(tiles.tiles_y * P, tiles.tiles_x * P, C)
    padded[:H, :W] = image
    return padded.view(tiles.tiles_y, P, tiles.tiles_x, P, C).permute(0, 2, 4, 1, 3).reshape(-1, C, P * P)


def tiles_to_image(values: Tensor, tiles: TileLists, camera: Camera) -> Tensor:
    """[tiles, C, P] -> [H, W, C]."""
    C, P = values.shape[1], tiles.tile_px
    image = values.reshape(tiles.tiles_y, tiles.tiles_x, C, P, P).permute(0, 3, 1, 4, 2)
    return image.reshape(tiles.tiles_y * P, tiles.tiles_x * P, C)[: camera.height, : camera.width]
