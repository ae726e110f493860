"""Around the kernels of the rasteriser, in numba and in CUDA: its output before they run, and what
was blended."""

import torch
from torch import Tensor

from gsfusion_nb.render.on_screen import ScreenGaussians
from gsfusion_nb.render.tiles import TileLists
from gsfusion_nb.types import Camera, RenderOutput

from ..composite.layout import TILE
from ..project.layout import CONIC_A, DEPTH, LN_OPACITY, RED, U
from ..runtime.arguments import parts


def blank(
    camera: Camera, device: torch.device, *, with_indices: bool, with_hits: bool
) -> RenderOutput:
    """An output that a kernel is to fill."""
    size = (camera.height, camera.width)
    rgb, depth_m, alpha = (
        torch.empty(*size, *n, dtype=torch.float32, device=device) for n in ((3,), (), ())
    )
    flags = (with_indices, with_indices, with_hits)
    first, dominant, hit_index = (
        torch.empty(size, dtype=torch.int64, device=device) if w else None for w in flags
    )
    return RenderOutput(
        rgb=rgb,
        depth_m=depth_m,
        alpha=alpha,
        first_index=first,
        dominant_index=dominant,
        hit_index=hit_index,
    )


def screen_of(
    splats: Tensor, ids: Tensor, offset: Tensor, camera: Camera, pixels: Tensor | None
) -> ScreenGaussians:
    """What was blended: rows of ``project.layout``, the lists of the tiles, and which pixels were
    drawn."""
    tiles_x = parts(camera.width, TILE)
    tiles_y = parts(camera.height, TILE)
    return ScreenGaussians(
        uv=splats[:, U : U + 2],
        conic=splats[:, CONIC_A : CONIC_A + 3],
        opacity=splats[:, LN_OPACITY].exp(),
        rgb=splats[:, RED : RED + 3],
        depth_m=splats[:, DEPTH],
        tiles=TileLists(
            gaussian=ids,
            offset=offset,
            tile_px=TILE,
            tiles_x=tiles_x,
            tiles_y=tiles_y,
            pixels=pixels,
        ),
    )
