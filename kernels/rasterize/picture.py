"""What renderers have in common around their kernels: arguments, the empty picture, the record of a drawn one."""

from dataclasses import dataclass

import torch
from torch import Tensor

from gsfusion_nb.backends import Record
from gsfusion_nb.checks import check_mask, check_positive, check_shape
from gsfusion_nb.types import Camera, GaussianParams, RenderOutput

from ..binning.tile_lists import TileLists


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawn(Record):
    """What the backward pass on a GPU needs of the forward one."""

    params: GaussianParams
    camera: Camera
    T_WC: Tensor
    splats: Tensor
    lists: TileLists
    image: tuple[Tensor, Tensor, Tensor]
    """Colour, depth, alpha."""
    pixels: Tensor | None
    """uint8"""


def check_options(camera: Camera, opaque_alpha: float | None, pixels: Tensor | None) -> None:
    """Raise ``ValueError`` unless the options of ``render_forward`` fit."""
    if opaque_alpha is not None:
        check_positive("opaque_alpha", opaque_alpha)
    if pixels is not None:
        check_mask("pixels", pixels, (camera.height, camera.width))


def blank(camera: Camera, device: torch.device, *, with_indices: bool, with_hits: bool) -> RenderOutput:
    """A picture that a kernel is to fill."""
    size = (camera.height, camera.width)
    rgb, depth_m, alpha = (torch.empty(*size, *n, dtype=torch.float32, device=device) for n in ((3,), (), ()))
    wanted = (with_indices, with_indices, with_hits)
    first, dominant, hit = (torch.empty(size, dtype=torch.int64, device=device) if w else None for w in wanted)
    return RenderOutput(
        rgb=rgb, depth_m=depth_m, alpha=alpha, first_index=first, dominant_index=dominant, hit_index=hit
    )


def check_gradients(
    drawn: Drawn, v_rgb: Tensor, v_depth_m: Tensor | None, v_alpha: Tensor | None, rows: Tensor | None
) -> None:
    """Raise ``ValueError`` unless the arguments of ``render_vjp`` have the sizes of the picture and of its map."""
    if not isinstance(drawn, Drawn):
        raise ValueError(f"render_vjp: the record that render_forward returns was expected, got {type(drawn).__name__}")
    size = (drawn.camera.height, drawn.camera.width)
    check_shape("v_rgb", v_rgb, (*size, 3))
    for name, value in (("v_depth_m", v_depth_m), ("v_alpha", v_alpha)):
        if value is not None:
            check_shape(name, value, size)
    if rows is not None:
        check_mask("rows", rows, (len(drawn.params),))
