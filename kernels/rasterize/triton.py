"""``render_forward`` and ``render_vjp`` from the kernels: what ``gsfusion_nb.backends`` offers for CUDA tensors.

Project and colour every row, list its tiles, sort, composite; and back. float64 goes to backend "torch". Gradients are
added up by atomics, in an order that changes from run to run: they repeat to rounding, not bit for bit.
"""

from typing import Any

import torch
from torch import Tensor

from gsfusion_nb.backends import use_backend
from gsfusion_nb.render import rasterize
from gsfusion_nb.types import Camera, GaussianParams, RenderOutput

from ..binning.triton import list_tiles
from ..composite.triton import STEP, TILE, composite_backward, composite_forward
from ..project.triton import SPLAT, project_rows, project_rows_vjp
from ..runtime.triton.launch import device_of, launch
from .picture import Drawn, blank, check_gradients, check_options


class TritonSaved(Drawn):
    """What the backward pass needs of the forward one."""

    backend = "triton"


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
        with use_backend("torch"):
            return rasterize.render_forward(
                params, camera, T_WC, with_indices=with_indices, opaque_alpha=opaque_alpha, pixels=pixels
            )
    device = device_of("render_forward", **vars(params), pixels=pixels)
    check_options(camera, opaque_alpha, pixels)
    pose = T_WC.detach().to(device, torch.float32).contiguous()
    splats, depth = project_rows(params, camera, pose)
    lists = list_tiles(splats, depth, camera, pixels)
    drawn = None if pixels is None else pixels.contiguous().view(torch.uint8)
    out = blank(camera, device, with_indices=with_indices, with_hits=opaque_alpha is not None)
    image = out.rgb, out.depth_m, out.alpha
    indices = (out.first_index, out.dominant_index, out.hit_index)
    launch(
        composite_forward, lists.n_tiles, device, splats, lists.ids, lists.offset,
        image[1] if drawn is None else drawn, *image, *(image[1] if index is None else index for index in indices),
        camera.width, camera.height, lists.tiles_x, float(opaque_alpha or 1.0), MASKED=drawn is not None,
        INDICES=with_indices, HITS=opaque_alpha is not None, TILE=TILE, STEP=STEP, num_warps=TILE * TILE // 64,
    )  # fmt: skip
    return out, TritonSaved(
        params=params, camera=camera, T_WC=pose, splats=splats, lists=lists, image=image, pixels=drawn
    )


def render_vjp(
    saved: Any,
    v_rgb: Tensor,
    v_depth_m: Tensor | None = None,
    v_alpha: Tensor | None = None,
    *,
    rows: Tensor | None = None,
) -> GaussianParams:
    """See ``gsfusion_nb.render.render_vjp``."""
    check_gradients(saved, v_rgb, v_depth_m, v_alpha, rows)
    splats, lists, camera, pixels = saved.splats, saved.lists, saved.camera, saved.pixels
    device = device_of("render_vjp", picture=splats, v_rgb=v_rgb, v_depth_m=v_depth_m, v_alpha=v_alpha, rows=rows)
    v_rgb, v_depth, v_opaque = (
        saved.image[1] if v is None else v.detach().contiguous().float() for v in (v_rgb, v_depth_m, v_alpha)
    )
    v_splats = torch.zeros(len(splats), SPLAT, dtype=torch.float32, device=device)
    launch(
        composite_backward, lists.n_tiles, device, splats, lists.ids, lists.offset,
        splats if pixels is None else pixels, splats if rows is None else rows.contiguous().view(torch.uint8),
        *saved.image, v_rgb, v_depth, v_opaque, v_splats, camera.width, camera.height, lists.tiles_x,
        MASKED=pixels is not None, SOME=rows is not None, DEPTH=v_depth_m is not None, ALPHA=v_alpha is not None,
        TILE=TILE, STEP=STEP, num_warps=TILE * TILE // 64,
    )  # fmt: skip
    return project_rows_vjp(saved.params, camera, saved.T_WC, splats, v_splats, rows)
