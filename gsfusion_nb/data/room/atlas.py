"""All charts of the room in one image with its mip levels, so that one ``cv2.remap`` textures a
whole view.

Level 0 fills the left part; level l, reduced by 2^l, is in the column to its right. Every chart is
surrounded by at least ``GUTTER`` texels that repeat (or, around a cone or ellipsoid, wrap) its
border, in a cell aligned to 2^LEVELS: half a texel of the coarsest level, which is what bilinear
lookups reach, so no level mixes neighbouring charts.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy import ndarray

LEVELS = 4

GUTTER = 8

WIDTH = 4096


@dataclass(frozen=True, kw_only=True, eq=False)
class AtlasLayout:
    """Position of each chart at level 0, texels."""

    x: ndarray
    y: ndarray
    w: ndarray
    h: ndarray
    texel_m: ndarray
    """Edge of a texel on the surface, metres (mean of both directions)."""
    height: int
    """Rows of the picture."""


def pack(
    sizes_px: Sequence[tuple[int, int]],
    texel_m: Sequence[float],
) -> AtlasLayout:
    """Place charts of the given (width, height) in rows, tallest first."""
    step = 2**LEVELS
    n = len(sizes_px)
    x = np.zeros(n, int)
    y = np.zeros(n, int)
    order = sorted(
        range(n),
        key=lambda i: (-sizes_px[i][1], i),
    )
    shelf_y = 0
    shelf_h = 0
    cursor = 0
    for i in order:
        outer_w, outer_h = (-(-(s + 2 * GUTTER) // step) * step for s in sizes_px[i])
        if cursor + outer_w > WIDTH:
            shelf_y = shelf_y + shelf_h
            shelf_h = 0
            cursor = 0
        shelf_h = max(shelf_h, outer_h)
        x[i] = cursor + GUTTER
        y[i] = shelf_y + GUTTER
        cursor += outer_w
    w, h = np.array(sizes_px).T
    return AtlasLayout(
        x=x,
        y=y,
        w=w,
        h=h,
        texel_m=np.array(texel_m, float),
        height=shelf_y + shelf_h,
    )


def paste(
    level0: ndarray,
    layout: AtlasLayout,
    i: int,
    picture: ndarray,
    wraps: bool,
) -> None:
    """Write chart ``i`` and its gutter into the level-0 picture (in place)."""
    step = 2**LEVELS
    x, y, w, h = (int(a[i]) for a in (layout.x, layout.y, layout.w, layout.h))
    right, bottom = (-(-(s + 2 * GUTTER) // step) * step - s - GUTTER for s in (w, h))
    with_border = np.pad(
        picture,
        ((GUTTER, bottom), (0, 0), (0, 0)),
        mode="edge",
    )
    with_border = np.pad(
        with_border,
        ((0, 0), (GUTTER, right), (0, 0)),
        mode="wrap" if wraps else "edge",
    )
    level0[y - GUTTER : y + h + bottom, x - GUTTER : x + w + right] = with_border


def with_mips(level0: ndarray) -> ndarray:
    """The level-0 picture [H, WIDTH, 3] with its box-filtered mip levels beside it. [H, 1.5 WIDTH,
    3]"""
    height = level0.shape[0]
    atlas = np.zeros((height, WIDTH + WIDTH // 2, 3), np.uint8)
    atlas[:, :WIDTH] = level0
    y = 0
    level = level0
    for _ in range(LEVELS):
        level = cv2.resize(
            level,
            (level.shape[1] // 2, level.shape[0] // 2),
            interpolation=cv2.INTER_AREA,
        )
        atlas[y : y + level.shape[0], WIDTH : WIDTH + level.shape[1]] = level
        y += level.shape[0]
    return atlas


def level_offsets(height: int) -> tuple[ndarray, ndarray]:
    """Column and row of each level's corner in the combined picture, texels. [LEVELS + 1] each"""
    rows = [0, 0]
    for level in range(1, LEVELS):
        rows.append(rows[-1] + (height >> level))
    return np.array([0] + [WIDTH] * LEVELS, np.float32), np.array(rows, np.float32)


def texels(atlas: ndarray, x: ndarray, y: ndarray) -> ndarray:
    """Bilinear texels at columns and rows of the combined picture. [N] -> [N, 3] uint8"""
    n = x.size
    side = 1024 if n >= 1024 else n  # cv2.remap takes pictures of fewer than 2^15 rows and columns
    blocks = np.zeros((2, -(-n // side) * side), np.float32)
    blocks[0, :n] = x
    blocks[1, :n] = y
    map_x, map_y = blocks.reshape(2, -1, side)
    return cv2.remap(atlas, map_x, map_y, cv2.INTER_LINEAR).reshape(-1, 3)[:n]
