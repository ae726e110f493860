"""A list entry, one Gaussian in one tile, as a quadratic polynomial of the pixel's place in the tile.

    ln(o exp(-sigma)) = ln o - (A dx^2 + C dy^2) / 2 - B dx dy,   (dx, dy) = (x, y) - (u, v)
                      = q_1 + q_x x + q_y y + q_xx x^2 + q_xy x y + q_yy y^2

with x, y and u, v measured from the middle of the tile. All tiles then share the six functions of x and y, so that
values at all pixels, and later the gradient of the six coefficients, are matrix products.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gsfusion_nb.constants import ALPHA_MIN
from gsfusion_nb.render.tiles import TileLists

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
