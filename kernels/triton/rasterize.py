"""``render_forward`` and ``render_vjp`` from the kernels: what ``gsfusion_nb.backends`` offers for CUDA tensors.

Project and colour every row, list its tiles, sort, composite; and back. float64 goes to the reference. Gradients are
added up by atomics, in an order that changes from run to run: they repeat to rounding, not bit for bit.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsfusion_nb.backends import use_backend
from gsfusion_nb.checks import check_mask, check_positive
from gsfusion_nb.render import rasterize as reference
from gsfusion_nb.types import Camera, GaussianParams, RenderOutput

from .binning import TileLists, list_tiles
from .composite import STEP, TILE, composite_backward, composite_forward
from .launch import device_of, launch
from .project import SPLAT, project_rows, project_rows_vjp


@dataclass(frozen=True, kw_only=True, eq=False)
class TritonSaved:
    """What the backward pass needs of the forward one."""

    params: GaussianParams
    camera: Camera
    T_WC: Tensor
    splats: Tensor
    lists: TileLists
    image: tuple[Tensor, Tensor, Tensor]
    """Colour, depth, alpha."""
    pixels: Tensor | None


def render_forward(
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    *,
    with_indices: bool = True,
    opaque_alpha: float | None = None,
    pixels: Tensor | None = None,
) -> tuple[RenderOutput, Any]:
    """See ``gsfusion_nb.render.render_forward``. The pose may be on any device."""
    if params.xyz_W.dtype != torch.float32:
        with use_backend("reference"):
            return reference.render_forward(
                params, camera, T_WC, with_indices=with_indices, opaque_alpha=opaque_alpha, pixels=pixels
            )
    device = device_of("render_forward", **vars(params), pixels=pixels)
    if opaque_alpha is not None:
        check_positive("opaque_alpha", opaque_alpha)
    if pixels is not None:
        check_mask("pixels", pixels, (camera.height, camera.width))
    pose = T_WC.detach().to(device, torch.float32).contiguous()
    splats, depth = project_rows(params, camera, pose)
    lists = list_tiles(splats, depth, camera, pixels)
    size = (camera.height, camera.width)
    rgb, opaque = (torch.empty(*size, *n, dtype=torch.float32, device=device) for n in ((3,), ()))
    image = rgb, torch.empty_like(opaque), opaque
    wanted = (with_indices, with_indices, opaque_alpha is not None)
    indices = [torch.empty(size, dtype=torch.int64, device=device) if w else None for w in wanted]
    launch(
        composite_forward, lists.tiles_x * lists.tiles_y, device, splats, lists.ids, lists.offset,
        image[1] if pixels is None else pixels.contiguous().view(torch.uint8), *image,
        *(image[1] if index is None else index for index in indices), *_size(camera, lists), float(opaque_alpha or 1.0),
        MASKED=pixels is not None, INDICES=with_indices, HITS=opaque_alpha is not None, TILE=TILE, STEP=STEP,
        num_warps=TILE * TILE // 64,
    )  # fmt: skip
    first, dominant, hit = indices
    output = RenderOutput(
        rgb=image[0], depth_m=image[1], alpha=image[2], first_index=first, dominant_index=dominant, hit_index=hit
    )
    saved = TritonSaved(params=params, camera=camera, T_WC=pose, splats=splats, lists=lists, image=image, pixels=pixels)
    return output, saved


def render_vjp(
    saved: Any,
    v_rgb: Tensor,
    v_depth_m: Tensor | None = None,
    v_alpha: Tensor | None = None,
    *,
    rows: Tensor | None = None,
) -> GaussianParams:
    """See ``gsfusion_nb.render.render_vjp``."""
    if isinstance(saved, reference.RenderSaved):
        with use_backend("reference"):
            return reference.render_vjp(saved, v_rgb, v_depth_m, v_alpha, rows=rows)
    if not isinstance(saved, TritonSaved):
        raise ValueError(
            f"render_vjp: a picture drawn by backend 'triton' was expected, got {type(saved).__name__} of another "
            "backend; draw and differentiate inside the same use_backend"
        )
    device = device_of("render_vjp", picture=saved.splats, v_rgb=v_rgb, v_depth_m=v_depth_m, v_alpha=v_alpha, rows=rows)
    if rows is not None:
        check_mask("rows", rows, (len(saved.params),))
    splats, lists, camera, pixels = saved.splats, saved.lists, saved.camera, saved.pixels
    v_rgb, v_depth, v_opaque = (
        saved.image[1] if v is None else v.detach().contiguous().float() for v in (v_rgb, v_depth_m, v_alpha)
    )
    v_splats = torch.zeros(len(splats), SPLAT, dtype=torch.float32, device=device)
    launch(
        composite_backward, lists.tiles_x * lists.tiles_y, device, splats, lists.ids, lists.offset,
        splats if pixels is None else pixels.contiguous().view(torch.uint8),
        splats if rows is None else rows.contiguous().view(torch.uint8),
        *saved.image, v_rgb, v_depth, v_opaque, v_splats, *_size(camera, lists), MASKED=pixels is not None,
        SOME=rows is not None, DEPTH=v_depth_m is not None, ALPHA=v_alpha is not None, TILE=TILE, STEP=STEP,
        num_warps=TILE * TILE // 64,
    )  # fmt: skip
    return project_rows_vjp(saved.params, camera, saved.T_WC, splats, v_splats, rows)


def _size(camera: Camera, lists: TileLists) -> tuple[int, int, int]:
    return camera.width, camera.height, lists.tiles_x
