"""An exercise of chapter 4: the tiles that a splat's box touches."""

import math
from typing import Any

import torch
from torch import Tensor

from ..render.constants import TILE_PX
from ..render.project import Projection
from ..render.tiles import TileLists
from ..types import Camera
from .exercise import Attempt, Becomes, Wrong, Yours, exercise

Number = float | int
Box = tuple[int, int, int, int]


def _ranges(
    low: Number,
    high: Number,
    tile_px: int,
    size: int,
) -> tuple[int, int]:
    n = -(-size // tile_px)
    first = min(max(math.floor(low / tile_px), 0), n)
    return first, max(
        first,
        min(max(math.floor(high / tile_px) + 1, 0), n),
    )


def _tiles_touched(
    u: Number, v: Number, extent_px: Number, width: int, height: int, tile_px: int
) -> Box:
    return (
        *_ranges(u - extent_px, u + extent_px, tile_px, width),
        *_ranges(v - extent_px, v + extent_px, tile_px, height),
    )


def _last_one_missing(
    u: Number, v: Number, extent_px: Number, width: int, height: int, tile_px: int
) -> Box:
    x0, x1, y0, y1 = _tiles_touched(u, v, extent_px, width, height, tile_px)
    return x0, max(x0, x1 - 1), y0, max(y0, y1 - 1)


def _unclamped(
    u: Number, v: Number, extent_px: Number, width: int, height: int, tile_px: int
) -> Box:
    low = [math.floor((c - extent_px) / tile_px) for c in (u, v)]
    high = [math.floor((c + extent_px) / tile_px) + 1 for c in (u, v)]
    return low[0], high[0], low[1], high[1]


def _whole_tiles_only(
    u: Number, v: Number, extent_px: Number, width: int, height: int, tile_px: int
) -> Box:
    return _tiles_touched(
        u, v, extent_px, width // tile_px * tile_px, height // tile_px * tile_px, tile_px
    )


def _as_tile_intersections(
    yours: Yours,
    projection: Projection,
    camera: Camera,
    *,
    tile_px: int = TILE_PX,
    pixels: Tensor | None = None,
) -> TileLists:
    """The Gaussians of each tile, nearest first, by your box of tiles around each Gaussian."""
    tiles_x = -(-camera.width // tile_px)
    tiles_y = -(-camera.height // tile_px)
    lists: list[list[int]] = [[] for _ in range(tiles_x * tiles_y)]
    like_box = torch.zeros(4, dtype=torch.int64)
    nearest_first = projection.depth_m.argsort(stable=True)
    for k in nearest_first[projection.visible[nearest_first]].tolist():
        u, v = projection.uv[k].tolist()
        extent_px = float(projection.extent_px[k].max())
        inputs = (u, v, extent_px, camera.width, camera.height, tile_px)
        x0, x1, y0, y1 = yours(*inputs, gives={"x0, x1, y0, y1": like_box}).tolist()
        if min(x0, y0) < 0 or x1 > tiles_x or y1 > tiles_y:
            yours.fail(
                f"returned {(x0, x1, y0, y1)}, but there are {tiles_x} x {tiles_y} tiles", inputs
            )
        for tile in [y * tiles_x + x for y in range(y0, y1) for x in range(x0, x1)]:
            lists[tile].append(k)
    if pixels is not None:  # tiles without any of them are not drawn
        for tile, members in enumerate(lists):
            y = tile // tiles_x * tile_px
            x = tile % tiles_x * tile_px
            if not pixels[y : y + tile_px, x : x + tile_px].any():
                members.clear()
    gaussian = torch.tensor(
        [k for members in lists for k in members],
        dtype=torch.int64,
        device=projection.uv.device,
    )
    offset = torch.tensor(
        [0, *(len(members) for members in lists)], device=projection.uv.device
    ).cumsum(0)
    return TileLists(
        gaussian=gaussian,
        offset=offset,
        tile_px=tile_px,
        tiles_x=tiles_x,
        tiles_y=tiles_y,
        pixels=pixels,
    )


@exercise(
    chapter=4,
    difficulty=2,
    minutes=10,
    solution=_tiles_touched,
    becomes=Becomes("tile_intersections", _as_tile_intersections),
    hints=(
        "Tile number of a coordinate: floor(coordinate / tile_px). Do it for u - extent and u + "
        "extent.",
        "The ranges are half open, like range(): the end is one more than the last tile.",
        "There are ceil(width / tile_px) tiles across. Clamp both ends to 0 .. that number.",
    ),
    wrong=(
        Wrong(_last_one_missing, says="a splat inside one tile is in that tile"),
        Wrong(_unclamped, says="tiles outside the picture do not exist"),
        Wrong(_whole_tiles_only, says="the last tile may reach beyond the picture's border"),
    ),
)
def tiles_touched(attempt: Attempt) -> None:
    """Which tiles does the box around a splat touch?"""
    names = ("x0", "x1", "y0", "y1")

    half_open = "the ranges are half open: the end is one past the last tile"
    border_words = "tiles outside the picture do not exist"
    beyond = "the last tile may reach beyond the picture's border"
    for u, v, extent, width, height, prop, why in (
        (12, 20, 2, 64, 48, "a splat inside one tile is in that tile", half_open),
        (31, 39, 1, 64, 48, "a coordinate belongs to the tile below it: floor, not round", ""),
        (16, 24, 5, 64, 48, "a splat across a border is on both sides", ""),
        (2, 3, 10, 64, 48, border_words, "clamp the ranges"),
        (62, 46, 10, 64, 48, border_words, "clamp the ranges"),
        (58, 43, 1, 60, 45, beyond, "ceil, not floor"),
    ):
        attempt.on(f"u {u}, v {v}, extent {extent}, picture {width} x {height}, tiles of 8")
        got = attempt.unpack(_as_list(attempt(u, v, extent, width, height, 8)), names)
        attempt.close(
            got,
            _tiles_touched(u, v, extent, width, height, 8),
            prop,
            why=why,
        )
    for case, u in (
        ("u -30, v 20, extent 5: left of the picture", -30.0),
        ("u 100, v 20: right of it", 100.0),
    ):
        x0, x1, *_ = box = attempt.unpack(
            _as_list(attempt.on(case)(u, 20.0, 5.0, 64, 48, 8)),
            names,
        )
        attempt.holds(
            x1 <= x0,
            "a splat outside the picture touches no tile",
            detail=f"got columns {x0} to {x1}",
        )
        in_picture = min(box) >= 0 and max(x0, x1) <= 8
        detail = f"got columns {x0} to {x1}, and there are 8: clamp both ends to 0 .. 8"
        attempt.holds(
            in_picture,
            "tiles outside the picture do not exist, not even as an empty range",
            detail=detail,
        )


def _as_list(value: Any) -> Any:
    """An array of four numbers as a list."""
    return value.tolist() if isinstance(value, Tensor) else value
