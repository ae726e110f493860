"""Which Gaussians touch which screen tile, nearest first (Kerbl et al. 2023, section 6)."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from ..backends import op
from ..errors import ArgumentError
from ..geometry.operands import MASK, check_camera, check_operand
from ..types import Camera
from .constants import TILE_PX
from .project import Projection


@dataclass(frozen=True, kw_only=True, eq=False)
class TileLists:
    """One list of Gaussians per tile, one after another: tile t has
    ``gaussian[offset[t] : offset[t + 1]]``."""

    gaussian: Int[Tensor, " I"]
    """Row of the Gaussian, by tile, then by depth."""
    offset: Int[Tensor, " T_plus_1"]
    """Start of each tile's list; the last number is the total. Tiles are numbered row by row."""
    tile_px: int
    """Edge of a tile, pixels."""
    tiles_x: int
    tiles_y: int
    pixels: Bool[Tensor, "H W"] | None = None
    """Pixels to draw; ``None`` means all. Tiles without such a pixel have empty lists."""

    def check(self, n: int, camera: Camera) -> None:
        """Raise ``ValueError`` unless these are lists of ``n`` Gaussians on the image of
        ``camera``."""
        tiles = (-(-camera.width // self.tile_px), -(-camera.height // self.tile_px))
        if (self.tiles_x, self.tiles_y) != tiles:
            raise ArgumentError(
                f"tiles must be {tiles[0]} x {tiles[1]} for this camera, got {self.tiles_x} x "
                f"{self.tiles_y}"
            )
        if (
            self.gaussian.device.type == "cpu"
            and len(self.gaussian)
            and int(self.gaussian.max()) >= n
        ):
            raise ArgumentError(
                f"tiles must name rows of the {n} Gaussians, got {int(self.gaussian.max())}; are "
                "they of another map?"
            )

    def gaussians_of(self, tile: int) -> Int[Tensor, " K"]:
        """The list of one tile, nearest first."""
        return self.gaussian[self.offset[tile] : self.offset[tile + 1]]

    def pixels_of(
        self,
        tile: int,
        camera: Camera,
    ) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"]]:
        """Rows and columns of the pixels of a tile that will be drawn."""
        pixels = self.pixels
        if pixels is None:
            pixels = torch.ones(
                camera.height, camera.width, dtype=torch.bool, device=self.gaussian.device
            )
        top = tile // self.tiles_x * self.tile_px
        first_column = tile % self.tiles_x * self.tile_px
        y, x = (
            pixels[top : top + self.tile_px, first_column : first_column + self.tile_px]
            .nonzero()
            .unbind(-1)
        )
        return top + y, first_column + x


def check_tiles(
    projection: Any, camera: Any, *, tile_px: int = TILE_PX, pixels: Any = None
) -> None:
    """Raise ``ValueError`` for arguments that ``tile_intersections`` refuses."""
    if not isinstance(projection, Projection):
        raise ArgumentError(f"projection must be a Projection, got {type(projection).__name__}")
    check_camera(camera)
    if not isinstance(tile_px, int) or tile_px < 1:
        raise ArgumentError(f"tile_px must be a whole number of at least 1, got {tile_px}")
    if pixels is not None:
        check_operand(
            "pixels",
            pixels,
            (camera.height, camera.width),
            dtypes=MASK,
            device=projection.uv.device,
        )


@op("binning", check_tiles)
def tile_intersections(
    projection: Projection,
    camera: Camera,
    *,
    tile_px: int = TILE_PX,
    pixels: Bool[Tensor, "H W"] | None = None,
) -> TileLists:
    """Sorted lists of the Gaussians that each tile may show.

    A Gaussian is listed in every tile that meets the box outside which its alpha is below 1/255. (A
    faster backend may leave out a tile that meets the box, but not the ellipse in it.) Equal depths
    keep row order.

    Args:
        projection: Screen-space Gaussians.
        camera: Gives the image size; the last row and column of tiles may reach beyond the image.
        tile_px: Edge of a tile, pixels. The picture does not depend on it.
        pixels: The pixels to draw; by default all. [H, W]

    Raises:
        ValueError: ``pixels`` is not boolean or not of the camera's size.

    Differentiable: no (a list; the neglected gradient at the border of a box is as small as the cut
    at 1/255).
    """
    nearest_first = projection.depth_m.argsort(stable=True)
    nearest_first = nearest_first[projection.visible[nearest_first]]
    low = (projection.uv - projection.extent_px)[nearest_first]
    high = (projection.uv + projection.extent_px)[nearest_first]
    lists = []
    for top in range(0, camera.height, tile_px):
        for first_column in range(0, camera.width, tile_px):
            corner = low.new_tensor([first_column, top])
            touches = ((low < corner + tile_px) & (high > corner)).all(dim=1)
            if (
                pixels is not None
                and not pixels[top : top + tile_px, first_column : first_column + tile_px].any()
            ):
                touches = torch.zeros_like(touches)
            lists.append(nearest_first[touches])
    ends = torch.tensor([0, *(len(gaussians) for gaussians in lists)], device=low.device).cumsum(0)
    return TileLists(
        gaussian=torch.cat(lists),
        offset=ends,
        tile_px=tile_px,
        tiles_x=-(-camera.width // tile_px),
        tiles_y=-(-camera.height // tile_px),
        pixels=pixels,
    )
