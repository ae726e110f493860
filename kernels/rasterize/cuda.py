"""``render_forward`` and ``render_vjp`` from the kernels: what ``gsfusion_nb.backends`` offers for CUDA tensors.

Project and colour every row, list its tiles, sort, composite; and back. float64 goes to backend "torch". Gradients are
added up by atomics, in an order that changes from run to run: they repeat to rounding, not bit for bit.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsfusion_nb.backends import use_backend
from gsfusion_nb.render import rasterize
from gsfusion_nb.types import Camera, GaussianParams, RenderOutput

from ..binning.cuda import list_tiles
from ..project.cuda import SPLAT, project_rows, project_rows_vjp
from ..runtime.cuda.launch import check_dtype, device_of, launch, packed
from .picture import Drawn, blank, check_gradients, check_options

_BLOCK = 128
_NO_HIT_ALPHA = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class CudaSaved(Drawn):
    """What the backward pass needs of the forward one."""

    backend = "cuda"
    depth: Tensor


def render_forward(
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
    if params.xyz_W.dtype == torch.float64:
        with use_backend("torch"):
            return rasterize.render_forward(
                params, camera, T_WC, with_indices=with_indices, opaque_alpha=opaque_alpha, pixels=pixels
            )
    device = device_of("render_forward", **vars(params), pixels=pixels)
    check_dtype("render_forward", torch.float32, **vars(params))
    check_options(camera, opaque_alpha, pixels)
    pose = packed(T_WC.to(device, torch.float32))
    splats, depth = project_rows(params, camera, pose)
    lists = list_tiles(splats, depth, camera, pixels)
    drawn = None if pixels is None else packed(pixels).view(torch.uint8)
    out = blank(camera, device, with_indices=with_indices, with_hits=opaque_alpha is not None)
    image = out.rgb, out.depth_m, out.alpha
    launch(
        "render_forward", f"composite:composite_{int(with_indices)}{int(opaque_alpha is not None)}", lists.n_tiles,
        _BLOCK, splats, lists.ids, lists.offset, drawn, *image, out.first_index, out.dominant_index, out.hit_index,
        camera.width, camera.height, lists.tiles_x, float(opaque_alpha or _NO_HIT_ALPHA),
    )  # fmt: skip
    return out, CudaSaved(
        params=params, camera=camera, T_WC=pose, splats=splats, depth=depth, lists=lists, image=image, pixels=drawn
    )


def render_vjp(
    saved: Any,
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
    check_gradients(saved, v_rgb, v_depth_m, v_alpha, rows)
    camera, lists = saved.camera, saved.lists
    device = device_of("render_vjp", picture=saved.splats, v_rgb=v_rgb, v_depth_m=v_depth_m, v_alpha=v_alpha, rows=rows)
    trained = None if rows is None else packed(rows).view(torch.uint8)
    v_image = [None if v is None else packed(v.float()) for v in (v_rgb, v_depth_m, v_alpha)]
    moments = torch.zeros(len(saved.splats), SPLAT, dtype=torch.float32, device=device)
    launch(
        "render_vjp", "composite:composite_backward", lists.n_tiles, _BLOCK, saved.splats, lists.ids, lists.offset,
        saved.pixels, trained, *saved.image, *v_image, moments, camera.width, camera.height, lists.tiles_x,
    )  # fmt: skip
    return project_rows_vjp(saved.params, camera, saved.T_WC, saved.splats, saved.depth, moments, trained)
