"""Which Gaussians touch which screen tile, nearest first, in whole-array torch code; for any device and float64.

The ellipse alpha = 1/255 is cut by each row of tiles; the columns between the leftmost and the rightmost point of the
cut are listed, which is exact (Hanson et al. 2025, "Speedy-Splat").
"""

import math

import torch
from jaxtyping import Bool
from torch import Tensor

from gsfusion_nb.render.constants import ALPHA_MIN, TILE_PX
from gsfusion_nb.render.project import Projection
from gsfusion_nb.render.tiles import TileLists
from gsfusion_nb.types import Camera


def tile_intersections(
    projection: Projection, camera: Camera, *, tile_px: int = TILE_PX, pixels: Bool[Tensor, "H W"] | None = None
) -> TileLists:
    """See ``gsfusion_nb.render.tile_intersections``."""
    tiles_x, tiles_y = -(-camera.width // tile_px), -(-camera.height // tile_px)
    u, v = projection.uv.unbind(-1)
    e_u, e_v = projection.extent_px.unbind(-1)
    drawn = projection.visible & (u + e_u > 0) & (u - e_u < camera.width) & (v + e_v > 0) & (v - e_v < camera.height)
    nearest = projection.depth_m.masked_fill(~drawn, torch.inf).argsort(stable=True)[: int(drawn.sum())]
    reach = projection.opacity.log()[:, None] - math.log(ALPHA_MIN)  # ln(255 o), the largest sigma that is drawn
    table = torch.cat([projection.uv, projection.extent_px, projection.conic, reach], dim=1)
    table = table.index_select(0, nearest).T.contiguous()

    # one line per (Gaussian, row of tiles)
    _, v, _, e_v, *_ = table
    y0, y1 = _tile_range(v - e_v, v + e_v, tile_px, camera.height)
    g, ty = _expand(y0, y1)
    left, right = _columns(table.index_select(1, g), ty * tile_px, tile_px)
    # one line per (Gaussian, tile)
    x0, x1 = _tile_range(left, right, tile_px, camera.width)
    line, tx = _expand(x0, x1)
    tile = (ty * tiles_x).index_select(0, line) + tx
    if pixels is not None:
        wanted = _active_tiles(pixels, tile_px).index_select(0, tile)
        line, tile = line[wanted], tile[wanted]
    tile, order = torch.sort(tile, stable=True)
    return TileLists(
        gaussian=nearest.index_select(0, g.index_select(0, line.index_select(0, order))),
        offset=torch.searchsorted(tile, torch.arange(tiles_x * tiles_y + 1, device=tile.device)),
        tile_px=tile_px,
        tiles_x=tiles_x,
        tiles_y=tiles_y,
        pixels=pixels,
    )


def _active_tiles(pixels: Tensor, tile_px: int) -> Tensor:
    """Whether each tile holds a pixel to be drawn. [tiles]"""
    H, W = pixels.shape
    padded = torch.nn.functional.pad(pixels, (0, -W % tile_px, 0, -H % tile_px))
    return padded.unflatten(1, (-1, tile_px)).unflatten(0, (-1, tile_px)).any(3).any(1).flatten()


def _tile_range(low: Tensor, high: Tensor, tile_px: int, size: int) -> tuple[Tensor, Tensor]:
    """First tile, and one past the last, with a pixel centre i + 0.5 between ``low`` and ``high``."""
    slack = 1e-2  # for rounding; a few more entries, the same picture
    first = (low - 0.5 - slack).ceil().clamp(0, size)
    end = ((high - 0.5 + slack).floor() + 1).clamp(0, size)
    first_tile = (first / tile_px).floor()
    end_tile = torch.where(end > first, (end / tile_px).ceil(), first_tile)
    return first_tile.long(), end_tile.long()


def _expand(first: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """Every integer of the ranges [first, end), in order: which range it is of, and the integer."""
    count = end - first
    which = torch.repeat_interleave(count)
    shift = first - count.cumsum(0) + count
    return which, torch.arange(len(which), device=first.device) + shift.index_select(0, which)


def _columns(ellipse: Tensor, top_px: Tensor, tile_px: int) -> tuple[Tensor, Tensor]:
    """Least and greatest x of the ellipse alpha = 1/255 between the first and last pixel centres of a row of tiles.

    The ellipse sigma = ln(255 o) is dx = -B/A dy +- h sqrt(1 - (dy / e_v)^2) with h = sqrt(2 ln(255 o) / A) and the
    extents e_u, e_v. Its rightmost point has dy = -B/C e_u; of the part in the band, it is where dy is nearest to that.
    """
    u, v, e_u, e_v, A, B, C, reach = ellipse
    top = top_px + 0.5 - v
    bottom = top + (tile_px - 1)
    dy_right = torch.clamp(-B / C * e_u, top, bottom)
    dy_left = torch.clamp(B / C * e_u, top, bottom)
    h = (2 * reach / A).sqrt()
    right = u - B / A * dy_right + h * (1 - (dy_right / e_v) ** 2).clamp_min(0.0).sqrt()
    left = u - B / A * dy_left - h * (1 - (dy_left / e_v) ** 2).clamp_min(0.0).sqrt()
    return left, right
