"""What the kernels share: the luma weights as whole numbers, the depth of the tree, and the columns
of its leaves."""

from torch import Tensor

from gsfusion_nb.seeding.quadtree import LUMA_WEIGHTS, Cells

LUMA_DENOMINATOR = 10_000
LUMA_NUMERATORS = tuple(round(w * LUMA_DENOMINATOR) for w in LUMA_WEIGHTS)
"""The luma weights as whole numbers, so that sums over pixels stay exact integers."""

LEAF_COLUMNS = X0, Y0, WIDTH, HEIGHT, LEVEL = range(5)
"""Rows of an array of leaves [5, n]: first column and row of pixels, size, level."""


def deepest_level(width: int, height: int, min_cell_px: int) -> int:
    """Level at which not even the largest cell may be cut. The largest of level l is ceil(size /
    2^l)."""
    level = 0
    while width // 2 > min_cell_px and height // 2 > min_cell_px:
        width = (width + 1) // 2
        height = (height + 1) // 2
        level = level + 1
    return level


def to_cells(leaves: Tensor) -> Cells:
    """The leaves from an array of theirs [5, n]."""
    return Cells(
        x0=leaves[X0],
        y0=leaves[Y0],
        width=leaves[WIDTH],
        height=leaves[HEIGHT],
        level=leaves[LEVEL],
    )
