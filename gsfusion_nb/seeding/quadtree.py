"""The image quadtree of GSFusion (section III-B.1): small cells where the picture varies, large ones where it does not.

Where an interval is cut depends only on the interval, so the cells of one level lie on a fixed grid of lines. The
integral images are therefore kept only where those lines cross, and a level is tested all at once.
"""

from dataclasses import dataclass, fields
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from ..backends import op
from ..checks import check_shape
from ..constants import LUMA_WEIGHTS, QUADTREE_NORMALISER

LUMA_DENOMINATOR = 10_000
LUMA_NUMERATORS = tuple(round(w * LUMA_DENOMINATOR) for w in LUMA_WEIGHTS)
"""The luma weights as whole numbers, so that sums over pixels stay exact integers."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cells:
    """Leaves of a quadtree, one row each. ``cells[mask]`` filters every column at once."""

    x0: Int[Tensor, " L"]
    """First pixel column."""
    y0: Int[Tensor, " L"]
    """First pixel row."""
    width: Int[Tensor, " L"]
    """Columns."""
    height: Int[Tensor, " L"]
    """Rows."""
    level: Int[Tensor, " L"]
    """Depth in the tree; the whole image is level 0."""

    def __len__(self) -> int:
        return self.x0.shape[0]

    def __getitem__(self, rows) -> "Cells":
        return Cells(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def __repr__(self) -> str:
        return f"Cells({len(self)} leaves, levels {sorted(set(self.level.tolist()))})"

    @property
    def centre_uv(self) -> Float[Tensor, "L 2"]:
        """Middle of each cell, continuous pixel coordinates."""
        return torch.stack([self.x0 + 0.5 * self.width, self.y0 + 0.5 * self.height], dim=-1)

    @property
    def half_diagonal_px(self) -> Float[Tensor, " L"]:
        """Distance from the middle to a corner, pixels."""
        return 0.5 * torch.hypot(self.width.float(), self.height.float())

    @property
    def area(self) -> Int[Tensor, " L"]:
        """Pixels in each cell."""
        return self.width * self.height


@op("quadtree")
def quadtree(
    rgb_u8: UInt8[Tensor, "H W 3"],
    *,
    threshold: float = 0.1,
    min_cell_px: int = 1,
    contrast: Literal["released", "std"] = "released",
) -> Cells:
    """Cut the image in four, and each part again, while a part's contrast is above ``threshold``.

    With V the luma-weighted population variance of a cell, V = 0.2989 var(R) + 0.5870 var(G) + 0.1140 var(B) on 0..255:
    "released": V (H W) / 9e7, H and W of the whole image, so a small image needs a smaller threshold;
    "std": sqrt(V) / 255, the same at every resolution.
    A cell is cut only if floor(width / 2) and floor(height / 2) both exceed ``min_cell_px``; the left and the top part
    get the floor, the right and the bottom part the rest.

    Args:
        rgb_u8: Colour, 0..255. [H, W, 3]
        threshold: Contrast above which a cell is cut, in the unit of ``contrast``.
        min_cell_px: Half sizes must stay above this, pixels.
        contrast: "released" or "std".

    Returns:
        The leaves. They tile the image without overlap, listed depth first: top left, bottom left, top right,
        bottom right.

    Raises:
        ValueError: wrong shape, an empty image, negative threshold, ``min_cell_px`` below 1, unknown contrast.

    Differentiable: no.

    Source: GSFusion section III-B.1; contrast, cutting and order as in the released code.
    """
    check_arguments(rgb_u8, threshold, min_cell_px, contrast)
    H, W = rgb_u8.shape[:2]
    finest = deepest_level(W, H, min_cell_px)
    xs, ys = (_grid_lines(n, finest).to(rgb_u8.device) for n in (W, H))
    corners = _integral_image(rgb_u8, xs, ys)
    order = _bits_apart(finest).to(rgb_u8.device)
    parts, keys = [], []
    alive = torch.ones((1, 1), dtype=torch.bool, device=rgb_u8.device)
    for level in range(finest + 1):
        step = 1 << (finest - level)
        x, y = xs[::step], ys[::step]
        w, h = x.diff(), y.diff()
        if level < finest:
            V = _variance(corners[:, ::step, ::step], w, h)
            value = V * (H * W) / QUADTREE_NORMALISER if contrast == "released" else V.sqrt() / 255
            large = (h // 2 > min_cell_px)[:, None] & (w // 2 > min_cell_px)[None, :]
            split = alive & large & (value > threshold)
        else:
            split = torch.zeros_like(alive)
        iy, ix = (alive & ~split).nonzero(as_tuple=True)
        parts.append((x[ix], y[iy], w[ix], h[iy], torch.full_like(ix, level)))
        keys.append(2 * order[ix * step] + order[iy * step])
        alive = _children(split)
    depth_first = torch.cat(keys).argsort()
    columns = [torch.cat(c)[depth_first].to(torch.int32) for c in zip(*parts, strict=True)]
    return Cells(x0=columns[0], y0=columns[1], width=columns[2], height=columns[3], level=columns[4])


def check_arguments(rgb_u8: Tensor, threshold: float, min_cell_px: int, contrast: str) -> None:
    """Raise ``ValueError`` for what ``quadtree`` does not take."""
    check_shape("rgb_u8", rgb_u8, ("H", "W", 3))
    if rgb_u8.dtype != torch.uint8:
        raise ValueError(f"rgb_u8 must hold 8-bit colours (torch.uint8), got {rgb_u8.dtype}")
    if rgb_u8.numel() == 0:
        raise ValueError(f"rgb_u8 must have at least one pixel, got {list(rgb_u8.shape)}")
    if not threshold >= 0:
        raise ValueError(f"threshold must be >= 0, got {threshold}")
    if min_cell_px < 1:
        raise ValueError(f"min_cell_px must be >= 1, got {min_cell_px}")
    if contrast not in ("released", "std"):
        raise ValueError(f"contrast must be 'released' or 'std', got {contrast!r}")


def deepest_level(width: int, height: int, min_cell_px: int) -> int:
    """Level at which not even the largest cell may be cut. The largest of level l is ceil(size / 2^l)."""
    level = 0
    while width // 2 > min_cell_px and height // 2 > min_cell_px:
        width, height, level = (width + 1) // 2, (height + 1) // 2, level + 1
    return level


def _grid_lines(length: int, levels: int) -> Int[Tensor, " G"]:
    """Cell borders along one axis at the deepest level; every 2^k-th of them are the borders k levels higher."""
    lines = torch.tensor([0, length])
    for _ in range(levels):
        middle = lines[:-1] + lines.diff() // 2
        lines = torch.cat([torch.stack([lines[:-1], middle], dim=1).flatten(), lines[-1:]])
    return lines


def _integral_image(
    rgb_u8: UInt8[Tensor, "H W 3"], xs: Int[Tensor, " Gx"], ys: Int[Tensor, " Gy"]
) -> Int[Tensor, "4 Gy Gx"]:
    """Sums over all pixels left of and above each crossing of grid lines: R, G, B, and the luma-weighted squares."""
    r, g, b = rgb_u8.to(torch.int32).unbind(-1)
    wr, wg, wb = LUMA_NUMERATORS
    squares = wr * r * r + wg * g * g + wb * b * b  # at most 9999 * 255^2 = 6.5e8, inside int32
    band = torch.repeat_interleave(ys.diff())
    column = torch.repeat_interleave(xs.diff())
    sums = torch.zeros((4, len(ys) - 1, rgb_u8.shape[1]), dtype=torch.int64, device=rgb_u8.device)
    for channel, plane in enumerate((r, g, b, squares)):
        sums[channel].index_add_(0, band, plane.long())
    cells = torch.zeros((len(xs) - 1, 4, len(ys) - 1), dtype=torch.int64, device=rgb_u8.device)
    cells.index_add_(0, column, sums.permute(2, 0, 1))
    table = cells.permute(1, 2, 0).cumsum(1).cumsum(2)
    return torch.nn.functional.pad(table, (1, 0, 1, 0))


def _variance(corners: Int[Tensor, "4 Gy Gx"], w: Int[Tensor, " X"], h: Int[Tensor, " Y"]) -> Float[Tensor, "Y X"]:
    """Luma-weighted population variance of every cell of one level, on 0..255: sum_c w_c (E[c^2] - E[c]^2)."""
    sums = corners.diff(dim=1).diff(dim=2)
    mean = sums.double() / (h[:, None] * w[None, :])
    V = mean[3]
    for weight, m in zip(LUMA_NUMERATORS, mean[:3], strict=True):
        V = V - weight * m * m
    return V.clamp_min(0.0) / LUMA_DENOMINATOR


def _children(split: Bool[Tensor, "Y X"]) -> Bool[Tensor, "Y2 X2"]:
    """The cells of the next level whose parent was cut."""
    return split.repeat_interleave(2, dim=0).repeat_interleave(2, dim=1)


def _bits_apart(levels: int) -> Int[Tensor, " G"]:
    """Each index below 2^levels with a zero between its bits; two such numbers interleave to the depth-first rank."""
    index = torch.arange(1 << levels)
    spread = torch.zeros_like(index)
    for bit in range(levels):
        spread |= ((index >> bit) & 1) << (2 * bit)
    return spread
