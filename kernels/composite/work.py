"""What the CUDA kernels that blend are given of the Gaussians: ``square.cuh``."""

from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

from gsfusion_nb.types import Camera

if TYPE_CHECKING:
    from ..binning.cuda import TileLists


class Work(NamedTuple):
    """What is to be composited, in which pixels (``None``: all)."""

    splats: Tensor
    ids: Tensor
    offset: Tensor
    pixels: Tensor | None
    width: int
    height: int
    tiles_x: int

    @staticmethod
    def of(splats: Tensor, lists: "TileLists", camera: Camera, pixels: Tensor | None) -> "Work":
        """The list of each tile of an image; ``pixels``: uint8, those to be drawn."""
        return Work(
            splats=splats,
            ids=lists.ids,
            offset=lists.offset,
            pixels=pixels,
            width=camera.width,
            height=camera.height,
            tiles_x=lists.tiles_x,
        )
