"""What the kernels share: the luma weights as whole numbers, and the depth of the tree."""

from gsfusion_nb.constants import LUMA_WEIGHTS

LUMA_DENOMINATOR = 10_000
LUMA_NUMERATORS = tuple(round(w * LUMA_DENOMINATOR) for w in LUMA_WEIGHTS)
"""The luma weights as whole numbers, so that sums over pixels stay exact integers."""


def deepest_level(width: int, height: int, min_cell_px: int) -> int:
    """Level at which not even the largest cell may be cut. The largest of level l is ceil(size / 2^l)."""
    level = 0
    while width // 2 > min_cell_px and height // 2 > min_cell_px:
        width, height, level = (width + 1) // 2, (height + 1) // 2, level + 1
    return level
