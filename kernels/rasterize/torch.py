"""The whole renderer in torch: the steps of the reference, with the stages of backend "torch"; also in float64."""

from typing import Any

from torch import Tensor

from gsfusion_nb.backends import Record, load, use_backend
from gsfusion_nb.render.rasterize import RenderSaved
from gsfusion_nb.types import Camera, GaussianParams, RenderOutput


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
