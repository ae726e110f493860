"""``render_over_base`` and its gradient in CUDA, offered for CUDA tensors: ``over_base.cu``.

Project and colour every row, list its tiles in any order, and sum up. float64 goes to the
reference. Gradients are added up by atomics, in an order that changes from run to run: they repeat
to rounding, not bit for bit.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsfusion_nb.backends import Record
from gsfusion_nb.render.constants import NEAR_PLANE_M
from gsfusion_nb.render.over_base import Base, OverBaseOutput
from gsfusion_nb.types import Camera, GaussianParams

from ..binning.cuda import TileLists, list_tiles
from ..project.cuda import gradients_of, project_rows
from ..runtime.arguments import check_dtype, packed
from ..runtime.cuda.launch import device_of, launch

_BLOCK = 128


@dataclass(frozen=True, kw_only=True, eq=False)
class CudaOverBase(Record):
    """What the backward pass needs of the forward one."""

    backend = "cuda"
    params: GaussianParams
    camera: Camera
    base: Base
    behind_m: float
    T_WC: Tensor
    splats: Tensor
    depth: Tensor
    """Of the splats, infinite for those that are not drawn."""
    lists: TileLists
    surface: dict[str, Any]
    """The base, and how far behind it Gaussians are drawn."""
    image: dict[str, Tensor]
    """What was drawn."""

    @property
    def work(self) -> dict[str, Any]:
        """What the kernels are given of the Gaussians."""
        return self.lists.work(self.splats, self.camera, pixels=None)


def render_over_base(
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    base: Base,
    *,
    behind_m: float,
    near_m: float = NEAR_PLANE_M,
) -> tuple[OverBaseOutput, Any]:
    """See ``gsfusion_nb.render.render_over_base``. The pose may be on any device.

    Raises:
        ValueError: tensors on several devices or of several types.
    """
    name = "render_over_base"
    device = device_of(name, params.xyz_W)
    check_dtype(name, torch.float32, **vars(params), **vars(base))
    pose = packed(T_WC.to(device, torch.float32))
    splats, depth = project_rows(params, camera, pose, near_m)
    surface = {
        "rgb": packed(base.rgb),
        "depth": packed(base.depth_m),
        "weight": packed(base.weight),
    }
    image = {name: torch.empty_like(x) for name, x in surface.items()}
    saved = CudaOverBase(
        params=params,
        camera=camera,
        base=base,
        behind_m=behind_m,
        T_WC=pose,
        splats=splats,
        depth=depth,
        lists=list_tiles(splats, depth, camera, None, by_depth=False),
        surface=surface | {"behind": behind_m},
        image=image,
    )
    launch(
        name,
        "over_base:over_base_forward",
        saved.lists.n_tiles,
        _BLOCK,
        saved.work,
        saved.surface,
        image,
    )
    return OverBaseOutput(rgb=image["rgb"], depth_m=image["depth"], weight=image["weight"]), saved


def render_over_base_vjp(
    saved: Any,
    v_rgb: Tensor,
    *,
    rows: Tensor | None = None,
    v_uv: Tensor | None = None,
    v_uv_abs: Tensor | None = None,
) -> GaussianParams:
    """See ``gsfusion_nb.render.render_over_base_vjp``.

    Raises:
        ValueError: tensors on several devices.
    """
    name = "render_over_base_vjp"
    device_of(name, v_rgb)
    given = (saved.surface, saved.image | {"v_rgb": packed(v_rgb.float())})
    centres = {"v_uv": v_uv, "v_uv_abs": v_uv_abs}
    return gradients_of(name, "over_base:over_base_backward", saved, *given, rows=rows, **centres)
