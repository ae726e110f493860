"""The whole renderer in torch: the steps of the reference, with the stages of backend "torch"; also in float64.

The output of the rasteriser before its kernels run, in numba and in CUDA.
"""

from typing import Any

import torch
from torch import Tensor

from gsfusion_nb.backends import Record, load, use_backend
from gsfusion_nb.render.rasterize import RenderSaved
from gsfusion_nb.types import Camera, GaussianParams, RenderOutput


def blank(camera: Camera, device: torch.device, *, with_indices: bool, with_hits: bool) -> RenderOutput:
    """An output that a kernel is to fill."""
    size = (camera.height, camera.width)
    rgb, depth_m, alpha = (torch.empty(*size, *n, dtype=torch.float32, device=device) for n in ((3,), (), ()))
    wanted = (with_indices, with_indices, with_hits)
    first, dominant, hit = (torch.empty(size, dtype=torch.int64, device=device) if w else None for w in wanted)
    return RenderOutput(
        rgb=rgb, depth_m=depth_m, alpha=alpha, first_index=first, dominant_index=dominant, hit_index=hit
    )


class TorchSaved(RenderSaved):
    """What the backward pass needs of the forward one."""

    backend = "torch"


def render_forward(params: GaussianParams, camera: Camera, T_WC: Tensor, **options: Any) -> tuple[RenderOutput, Record]:
    """See ``gsfusion_nb.render.render_forward``."""
    with use_backend("torch"):
        output, saved = load("render_forward", "reference")(params, camera, T_WC, **options)
    return output, TorchSaved(**vars(saved))


def render_vjp(
    saved: TorchSaved,
    v_rgb: Tensor,
    v_depth_m: Tensor | None = None,
    v_alpha: Tensor | None = None,
    *,
    rows: Tensor | None = None,
    v_uv: Tensor | None = None,
    v_uv_abs: Tensor | None = None,
) -> GaussianParams:
    """See ``gsfusion_nb.render.render_vjp``."""
    with use_backend("torch"):
        reference = load("render_vjp", "reference")
        return reference(saved, v_rgb, v_depth_m, v_alpha, rows=rows, v_uv=v_uv, v_uv_abs=v_uv_abs)
