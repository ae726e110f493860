"""The image quadtree of GSFusion (section III-B.1): small cells where the picture varies, large
ones elsewhere."""

from dataclasses import dataclass, fields
from typing import Any, Literal

import torch
from jaxtyping import Float, Int, Shaped, UInt8
from torch import Tensor

from ..backends import op, piece
from ..checks import check_number
from ..errors import ArgumentError
from ..geometry import backproject, se3
from ..geometry.operands import check_operand
from ..types import Camera

LUMA_WEIGHTS = (0.2989, 0.5870, 0.1140)
"""Weights of R, G, B in the quadtree's contrast (ITU-R BT.601 as the released code rounds them)."""

QUADTREE_NORMALISER = 9e7
"""The released code multiplies a cell's variance by (image pixels) / 9e7 before the threshold
test."""

Cell = tuple[int, int, int, int]
"""First column, first row, width, height, pixels."""


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

    @classmethod
    def cat(cls, parts: "list[Cells]") -> "Cells":
        """All leaves of at least one part, in the order of the parts."""
        return cls(
            **{f.name: torch.cat([getattr(part, f.name) for part in parts]) for f in fields(cls)}
        )

    @property
    def centre_uv(self) -> Float[Tensor, "L 2"]:
        """Middle of each cell, continuous pixel coordinates."""
        return torch.stack(
            [self.x0 + 0.5 * self.width, self.y0 + 0.5 * self.height],
            dim=-1,
        )

    @property
    def half_diagonal_px(self) -> Float[Tensor, " L"]:
        """Distance from the middle to a corner, pixels."""
        return 0.5 * torch.hypot(self.width.float(), self.height.float())

    @property
    def area(self) -> Int[Tensor, " L"]:
        """Pixels in each cell."""
        return self.width * self.height


def check_quadtree(
    rgb_u8: Any, *, threshold: float = 0.1, min_cell_px: int = 1, contrast: str = "released"
) -> None:
    """Raise ``ValueError`` for arguments that ``quadtree`` refuses."""
    check_operand("rgb_u8", rgb_u8, ("H", "W", 3), dtypes=(torch.uint8,))
    if rgb_u8.numel() == 0:
        raise ArgumentError(f"rgb_u8 must have at least one pixel, got {list(rgb_u8.shape)}")
    check_number("threshold", threshold, 0)
    check_number("min_cell_px", min_cell_px, 1)
    if contrast not in ("released", "std"):
        raise ArgumentError(f"contrast must be 'released' or 'std', got {contrast!r}")


@op("quadtree", check_quadtree)
def quadtree(
    rgb_u8: UInt8[Tensor, "H W 3"],
    *,
    threshold: float = 0.1,
    min_cell_px: int = 1,
    contrast: Literal["released", "std"] = "released",
) -> Cells:
    """Cut the image in four, and each part again, while a part's contrast is above ``threshold``.

    With V the variance of a cell, see ``luma_variance``:
    "released": V (H W) / 9e7, H and W of the whole image, so a small image needs a smaller
    threshold; "std": sqrt(V) / 255, the same at every resolution.
    A cell is cut only if floor(width / 2) and floor(height / 2) both exceed ``min_cell_px``.

    Args:
        rgb_u8: Colour, 0..255. [H, W, 3]
        threshold: Contrast above which a cell is cut, in the unit of ``contrast``.
        min_cell_px: A cell is cut only while half its width and half its height are above this,
            pixels.
        contrast: "released" or "std".

    Returns:
        The leaves. They tile the image without overlap, listed depth first: top left, bottom left,
        top right, bottom right.

    Raises:
        ValueError: wrong shape, an empty image, negative threshold, ``min_cell_px`` below 1,
            unknown contrast.

    Differentiable: no.

    Source: GSFusion section III-B.1; contrast, cutting and order as in the released code.
    """
    H, W = rgb_u8.shape[:2]

    def is_cut(x0: int, y0: int, w: int, h: int) -> bool:
        if w // 2 <= min_cell_px or h // 2 <= min_cell_px:
            return False
        V = luma_variance(rgb_u8[y0 : y0 + h, x0 : x0 + w])
        return (
            V * (H * W) / QUADTREE_NORMALISER if contrast == "released" else V**0.5 / 255
        ) > threshold

    def leaves(cell: Cell, level: int) -> list[tuple[int, ...]]:
        if not is_cut(*cell):
            return [(*cell, level)]
        return [leaf for part in cut(*cell) for leaf in leaves(part, level + 1)]

    rows = torch.tensor(
        leaves((0, 0, W, H), 0),
        dtype=torch.int32,
        device=rgb_u8.device,
    )
    x0, y0, width, height, level = rows.T.contiguous()
    return Cells(x0=x0, y0=y0, width=width, height=height, level=level)


@piece
def luma_variance(rgb: Shaped[Tensor, "h w 3"]) -> float:
    """V = 0.2989 var(R) + 0.5870 var(G) + 0.1140 var(B), the variances of all pixels of a cell, on
    0..255."""
    r, g, b = rgb.double().flatten(0, 1).var(dim=0, correction=0).tolist()
    return LUMA_WEIGHTS[0] * r + LUMA_WEIGHTS[1] * g + LUMA_WEIGHTS[2] * b


@piece
def cut(
    x0: int,
    y0: int,
    width: int,
    height: int,
) -> list[Cell]:
    """The four parts of a cell: top left, bottom left, top right, bottom right. Left and top get
    the floor of half."""
    w = width // 2
    h = height // 2
    return [
        (x0, y0, w, h),
        (x0, y0 + h, w, height - h),
        (x0 + w, y0, width - w, h),
        (x0 + w, y0 + h, width - w, height - h),
    ]


def cut_to_size(
    cells: Cells,
    camera: Camera,
    depth_m: Float[Tensor, "H W"],
    largest_m: float,
    *,
    min_cell_px: int = 1,
) -> Cells:
    """Cut cells in four, and each part again, while the Gaussian of a cell would be larger than
    ``largest_m``: while z r / fx > ``largest_m``, with r half the diagonal of the cell and z the
    depth of the pixel in its middle.

    The quadtree leaves a surface without texture in one piece, and a Gaussian as large as a wall
    neither ends where the wall does nor follows it where it turns. Here the depth decides how large
    a Gaussian may be, in metres, at every image size. A cell whose middle has no depth stays.

    Args:
        cells: Leaves of the quadtree, inside the image of ``depth_m``.
        camera: Its focal length counts.
        depth_m: z-depth, metres; 0: missing. [H, W]
        largest_m: Largest standard deviation, metres.
        min_cell_px: A cell is cut only while half its width and half its height are above this,
            pixels.

    Returns:
        The leaves, which tile the same pixels. Those that are not cut come first, in their order.

    Differentiable: no. Source: ours; docs/gsfusion.md has what it changes.
    """
    parts = []
    while len(cells):
        i, j = cells.centre_uv.floor().long().unbind(-1)
        size_m = depth_m[j, i] * cells.half_diagonal_px / camera.fx
        is_cut = (size_m > largest_m) & (
            torch.minimum(cells.width, cells.height) // 2 > min_cell_px
        )
        parts.append(cells[~is_cut])
        cells = quarters(cells[is_cut])
    return Cells.cat(parts) if parts else cells


def quarters(cells: Cells) -> Cells:
    """The four parts of each cell, a level deeper; each is as in ``cut``."""
    half_width = cells.width // 2
    half_height = cells.height // 2
    middle_x = cells.x0 + half_width
    middle_y = cells.y0 + half_height
    right_width = cells.width - half_width
    lower_height = cells.height - half_height
    return Cells(
        x0=torch.cat([cells.x0, cells.x0, middle_x, middle_x]),
        y0=torch.cat([cells.y0, middle_y, cells.y0, middle_y]),
        width=torch.cat([half_width, half_width, right_width, right_width]),
        height=torch.cat([half_height, lower_height, half_height, lower_height]),
        level=(cells.level + 1).repeat(4),
    )


@piece
def cell_gaussians(
    camera: Camera,
    cells: Cells,
    depth_m: Float[Tensor, "H W"],
    T_WC: Float[Tensor, "4 4"],
) -> tuple[Float[Tensor, "L 3"], Float[Tensor, " L"]]:
    """Position and standard deviation of the Gaussian of each cell, whose middle must lie on a
    pixel with depth.

    The middle (u, v) is lifted with the depth z of the pixel that contains it, to T_WC (z K^-1 (u,
    v, 1)); the standard deviation is z r / fx, with r half the diagonal.

    Returns:
        xyz_W [L, 3] and scale_m [L], metres, world frame.

    Source: GSFusion section III-B.2, Eq. 10.
    """
    uv = cells.centre_uv
    i, j = uv.floor().long().unbind(-1)
    z = depth_m[j, i]
    xyz_W = se3.apply(T_WC, backproject(camera, uv.to(z.dtype), z))  # GSFusion Eq. 10
    return xyz_W, z * cells.half_diagonal_px / camera.fx
