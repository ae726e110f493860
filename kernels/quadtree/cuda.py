"""The image quadtree in two passes up and one down: ``quadtree.cu``. The host waits once, for the
number of leaves."""

from typing import Any, Literal

import torch
from torch import Tensor

from gsfusion_nb.seeding.quadtree import QUADTREE_NORMALISER, Cells

from ..runtime.arguments import parts
from ..runtime.cuda.launch import device_of, launch
from .layout import LEAF_COLUMNS, LUMA_DENOMINATOR, LUMA_NUMERATORS, deepest_level, to_cells

_BLOCK = 256
_CLIMB = {"sum_cells": 3, "add_levels": 4}
"""Levels that a block of threads climbs from those it starts with: from 64 and from 256 cells to
one."""
_PART = 5
"""Numbers of 64 bits that go from level to level for each cell."""
_ROOT = 3
"""Place of the number of all leaves."""
_MOST_PIXELS = 256
_MOST_EXTRA_LEVELS = 7
"""A cell larger than this is summed in parts, as long as there are few of those."""


def quadtree(
    rgb_u8: Tensor,
    *,
    threshold: float = 0.1,
    min_cell_px: int = 1,
    contrast: Literal["released", "std"] = "released",
) -> Cells:
    """See ``gsfusion_nb.seeding.quadtree``."""
    device = device_of("quadtree", rgb_u8)
    height, width = rgb_u8.shape[:2]
    levels = deepest_level(width, height, min_cell_px)
    leaves = torch.empty(_ROOT + (4**levels - 1) // 3, dtype=torch.int32, device=device)
    total = 1
    if levels:
        red, green, blue = LUMA_NUMERATORS
        rule = {"width": width, "height": height, "levels": levels, "min_cell_px": min_cell_px}
        rule |= {
            "released": contrast == "released",
            "threshold": threshold,
            "normaliser": QUADTREE_NORMALISER,
        }
        rule |= {"red": red, "green": green, "blue": blue, "denominator": LUMA_DENOMINATOR}
        _count_leaves(rgb_u8.contiguous(), leaves, _summed_level(width, height, levels), rule)
        total = int(leaves[_ROOT])
    out = torch.empty((len(LEAF_COLUMNS), total), dtype=torch.int32, device=device)
    launch(
        "quadtree",
        "quadtree:emit_leaves",
        parts(4**levels, _BLOCK),
        _BLOCK,
        leaves,
        out,
        total,
        levels,
        width,
        height,
    )
    return to_cells(out)


def _count_leaves(
    rgb_u8: Tensor,
    leaves: Tensor,
    level: int,
    rule: dict[str, Any],
) -> None:
    """Leaves below every cell, from the cells of ``level`` up to the whole picture."""
    source = rgb_u8
    kernel = "sum_cells"
    while level >= 0:
        up = min(_CLIMB[kernel], level)
        top = torch.empty(4 ** (level - up) * _PART, dtype=torch.int64, device=rgb_u8.device)
        launch(
            "quadtree",
            f"quadtree:{kernel}",
            4 ** (level - up),
            _BLOCK,
            source,
            leaves,
            top,
            4**up,
            level,
            rule,
        )
        source = top
        kernel = "add_levels"
        level = level - up - 1


def _summed_level(width: int, height: int, levels: int) -> int:
    """Level at which pixels are summed: that of the smallest cells that may be cut, or one where
    cells are small."""
    level = 0
    while level < _MOST_EXTRA_LEVELS and width * height > _MOST_PIXELS:
        width = (width + 1) // 2
        height = (height + 1) // 2
        level = level + 1
    return max(levels - 1, level)
