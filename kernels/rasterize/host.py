"""``render_forward`` and ``render_vjp`` on a GPU: what Triton and CUDA have in common around their kernels.

Project and colour every row, list its tiles, sort, composite; and back. Other numbers than float32 go to backend
"torch". Gradients are added up by atomics, in an order that changes from run to run: they repeat to rounding, not bit
for bit.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfusion_nb.backends import Record
from gsfusion_nb.types import Camera, GaussianParams, RenderOutput

from ..binning.host import TileLists
from ..project.splat import SPLAT
from ..runtime.gpu import check_dtype, packed


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture(Record):
    """What the backward pass needs of the forward one; a backend adds its name."""

    params: GaussianParams
    camera: Camera
    T_WC: Tensor
    splats: Tensor
    depth: Tensor
    """Of the splats, infinite for those that are not drawn."""
    lists: TileLists
    image: tuple[Tensor, Tensor, Tensor]
    """Colour, depth, alpha."""
    pixels: Tensor | None
    """uint8, those to be drawn; ``None`` for all."""


class ImageGradients(NamedTuple):
    """dL/d of the image; ``None`` stands for zero."""

    v_rgb: Tensor
    v_depth: Tensor | None
    v_alpha: Tensor | None


class Kernels(NamedTuple):
    """The stages of a backend."""

    picture: type[Picture]
    device_of: Callable[..., torch.device]
    project: Callable[[GaussianParams, Camera, Tensor], tuple[Tensor, Tensor]]
    """Splats and their depths from parameters, camera and pose."""
    list_tiles: Callable[[Tensor, Tensor, Camera, Tensor | None], TileLists]
    """From splats, depths, camera and the mask of pixels."""
    composite: Callable[[Picture, RenderOutput, float | None], None]
    """Fills the output of a picture; the last is the alpha of a hit."""
    composite_vjp: Callable[[Picture, ImageGradients, Tensor | None, Tensor], None]
    """From dL/d of the image and the rows to be trained, uint8, adds to the sums of every splat [N, SPLAT]."""
    project_vjp: Callable[[Picture, Tensor, Tensor | None], GaussianParams]
    """From these sums and the rows to be trained."""


def render_forward(
    kernels: Kernels,
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    *,
    with_indices: bool = True,
    opaque_alpha: float | None = None,
    pixels: Tensor | None = None,
) -> tuple[RenderOutput, Any]:
    """See ``gsfusion_nb.render.render_forward``. The pose may be on any device.

    Raises:
        ValueError: tensors on several devices or of several types, a wrong mask.
    """
    device = kernels.device_of("render_forward", **vars(params), pixels=pixels)
    check_dtype("render_forward", torch.float32, **vars(params))
    pose = packed(T_WC.to(device, torch.float32))
    splats, depth = kernels.project(params, camera, pose)
    out = blank(camera, device, with_indices=with_indices, with_hits=opaque_alpha is not None)
    picture = kernels.picture(
        params=params,
        camera=camera,
        T_WC=pose,
        splats=splats,
        depth=depth,
        lists=kernels.list_tiles(splats, depth, camera, pixels),
        image=(out.rgb, out.depth_m, out.alpha),
        pixels=as_bytes(pixels),
    )
    kernels.composite(picture, out, opaque_alpha)
    return out, picture


def render_vjp(
    kernels: Kernels,
    picture: Any,
    v_rgb: Tensor,
    v_depth_m: Tensor | None = None,
    v_alpha: Tensor | None = None,
    *,
    rows: Tensor | None = None,
) -> GaussianParams:
    """See ``gsfusion_nb.render.render_vjp``.

    Raises:
        ValueError: the picture is of another backend, tensors are on several devices, a mask is wrong.
    """
    tensors = {"v_rgb": v_rgb, "v_depth_m": v_depth_m, "v_alpha": v_alpha, "rows": rows}
    device = kernels.device_of("render_vjp", picture=picture.splats, **tensors)
    v_depth, v_opacity = (None if v is None else packed(v.float()) for v in (v_depth_m, v_alpha))
    v_image = ImageGradients(v_rgb=packed(v_rgb.float()), v_depth=v_depth, v_alpha=v_opacity)
    trained = as_bytes(rows)
    sums = torch.zeros(len(picture.splats), SPLAT, dtype=torch.float32, device=device)
    kernels.composite_vjp(picture, v_image, trained, sums)
    return kernels.project_vjp(picture, sums, trained)


def as_bytes(mask: Tensor | None) -> Tensor | None:
    """A boolean mask as uint8, which kernels read; ``None`` stays."""
    return None if mask is None else packed(mask).view(torch.uint8)


def blank(camera: Camera, device: torch.device, *, with_indices: bool, with_hits: bool) -> RenderOutput:
    """An output that a kernel is to fill."""
    size = (camera.height, camera.width)
    rgb, depth_m, alpha = (torch.empty(*size, *n, dtype=torch.float32, device=device) for n in ((3,), (), ()))
    wanted = (with_indices, with_indices, with_hits)
    first, dominant, hit = (torch.empty(size, dtype=torch.int64, device=device) if w else None for w in wanted)
    return RenderOutput(
        rgb=rgb, depth_m=depth_m, alpha=alpha, first_index=first, dominant_index=dominant, hit_index=hit
    )
