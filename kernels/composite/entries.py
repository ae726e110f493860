"""Vectorised compositing: pairs of Gaussian and tile in chunks of similar length, and their share in each pixel."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gsfusion_nb.render.constants import ALPHA_MIN, TRANSMITTANCE_MIN
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


_Q_1, _Q_X, _Q_Y, _Q_XX, _Q_XY, _Q_YY = range(6)
"""Columns of the polynomials."""

_U, _V, _A, _B, _C, OPACITY = range(6)
UV, CONIC = slice(_U, _A), slice(_A, OPACITY)
"""Columns of the gradient of an ellipse."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Entries:
    """The entries of all lists, and after them one that is not there (row 0, alpha zero) to fill short lists up."""

    row: Int[Tensor, " I_plus_1"]
    """The Gaussian."""
    u: Float[Tensor, " I"]
    """Its centre from the middle of the tile, pixels."""
    v: Float[Tensor, " I"]
    poly: Float[Tensor, "I_plus_1 6"]
    """q_1, q_x, q_y, q_xx, q_xy, q_yy."""


def list_entries(
    tiles: TileLists, uv: Float[Tensor, "N 2"], conic: Float[Tensor, "N 3"], opacity: Float[Tensor, " N"]
) -> Entries:
    """The polynomial of every entry (formula at the top of this file). Differentiable: ``entries_vjp``."""
    row, P = tiles.gaussian, tiles.tile_px
    u, v, A, B, C, ln_o = torch.cat([uv, conic, opacity.log()[:, None]], dim=1).T.contiguous().index_select(1, row)
    tile = torch.repeat_interleave(tiles.offset.diff(), output_size=len(row))
    tile_y = tile // tiles.tiles_x
    tile_x = tile - tile_y * tiles.tiles_x
    u, v = u - (tile_x * P + P / 2), v - (tile_y * P + P / 2)
    q_x, q_y = A * u + B * v, B * u + C * v
    poly = torch.empty(len(row) + 1, 6, dtype=uv.dtype, device=uv.device)
    poly[:-1, _Q_1] = ln_o - 0.5 * (q_x * u + q_y * v)
    poly[:-1, _Q_X] = q_x
    poly[:-1, _Q_Y] = q_y
    poly[:-1, _Q_XX] = -0.5 * A
    poly[:-1, _Q_XY] = -B
    poly[:-1, _Q_YY] = -0.5 * C
    poly[-1] = 0.0
    poly[-1, _Q_1] = -20.0  # e^-20 is below the 1/255 cut
    return Entries(row=torch.cat([row, row.new_zeros(1)]), u=u, v=v, poly=poly)


def entries_vjp(entries: Entries, v_poly: Float[Tensor, "I_plus_1 6"], opacity: Float[Tensor, " N"]) -> Tensor:
    """dL/d (u, v, A, B, C, o) of every Gaussian: chain rule through each polynomial, then their sum. [N, 6]"""
    _, q_x, q_y, half_A, minus_B, half_C = entries.poly[:-1].T
    u, v, A, B, C = entries.u, entries.v, -2 * half_A, -minus_B, -2 * half_C
    v_1, v_x, v_y, v_xx, v_xy, v_yy = v_poly[:-1].T
    v_entry = torch.empty(len(u), 6, dtype=u.dtype, device=u.device)
    v_entry[:, _U] = A * v_x + B * v_y - q_x * v_1
    v_entry[:, _V] = B * v_x + C * v_y - q_y * v_1
    v_entry[:, _A] = u * v_x - 0.5 * (u * u * v_1 + v_xx)
    v_entry[:, _B] = v * v_x + u * v_y - u * v * v_1 - v_xy
    v_entry[:, _C] = v * v_y - 0.5 * (v * v * v_1 + v_yy)
    v_entry[:, OPACITY] = v_1
    total = u.new_zeros(len(opacity), 6).index_add_(0, entries.row[:-1], v_entry)
    total[:, OPACITY] /= opacity.clamp_min(ALPHA_MIN)  # d ln o = do / o; a Gaussian below 1/255 is in no list
    return total


def centre_slopes(
    entries: Entries, entry: Int[Tensor, " M"], functions: Float[Tensor, "6 P"]
) -> tuple[Float[Tensor, "M P"], Float[Tensor, "M P"]]:
    """d(ln alpha)/du = A dx + B dy and d(ln alpha)/dv = B dx + C dy of some entries at the pixels of their tiles.

    They are the derivatives of the polynomials by x and y, with the opposite sign.
    """
    _, q_x, q_y, q_xx, q_xy, q_yy = entries.poly.index_select(0, entry).T
    along_u, along_v = torch.stack([q_x, 2 * q_xx, q_xy]), torch.stack([q_y, q_xy, 2 * q_yy])
    return -along_u.T @ functions[:3], -along_v.T @ functions[:3]


def pixel_functions(tiles: TileLists, like: Tensor) -> Float[Tensor, "6 P"]:
    """1, x, y, x^2, x y, y^2 at the pixel centres of a tile, row by row."""
    i = torch.arange(tiles.tile_px, device=like.device, dtype=like.dtype) + 0.5 - tiles.tile_px / 2
    y, x = torch.meshgrid(i, i, indexing="ij")
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y]).flatten(1)
