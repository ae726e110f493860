"""``render_forward`` and ``render_vjp`` in CUDA, which ``gsfusion_nb.backends`` offers for CUDA
tensors.

Project and colour every row, list its tiles, sort, composite; and back. float64 goes to the
reference. Gradients are added up by atomics, in an order that changes from run to run: they repeat
to rounding, not bit for bit.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsfusion_nb.backends import Record
from gsfusion_nb.render.constants import NEAR_PLANE_M
from gsfusion_nb.render.on_screen import ScreenGaussians
from gsfusion_nb.types import Camera, GaussianParams, RenderOutput

from ..binning.cuda import TileLists, list_tiles
from ..project.cuda import gradients_of, project_rows
from ..runtime.arguments import as_bytes, check_dtype, packed
from ..runtime.cuda.launch import device_of, launch
from .host import blank, screen_of

_BLOCK = 128
_NO_HIT_ALPHA = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class CudaPicture(Record):
    """What the backward pass needs of the forward one."""

    backend = "cuda"
    params: GaussianParams
    camera: Camera
    T_WC: Tensor
    splats: Tensor
    depth: Tensor
    """Of the splats, infinite for those that are not drawn."""
    lists: TileLists
    image: dict[str, Tensor]
    """"rgb", "depth" and "alpha"."""
    pixels: Tensor | None
    """uint8, those to be drawn; ``None`` for all."""

    @property
    def work(self) -> dict[str, Any]:
        """What the kernels are given."""
        return self.lists.work(self.splats, self.camera, self.pixels)

    @property
    def screen(self) -> ScreenGaussians:
        """What was blended."""
        shape = (self.camera.height, self.camera.width)
        pixels = self.pixels
        drawn = None if pixels is None else pixels.reshape(shape).bool()
        return screen_of(self.splats, self.lists.ids, self.lists.offset, self.camera, drawn)


def render_forward(
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    *,
    with_indices: bool = True,
    opaque_alpha: float | None = None,
    pixels: Tensor | None = None,
    near_m: float = NEAR_PLANE_M,
    far_m: float = math.inf,
) -> tuple[RenderOutput, Any]:
    """See ``gsfusion_nb.render.render_forward``. The pose may be on any device.

    Raises:
        ValueError: tensors on several devices or of several types, a wrong mask.
    """
    device = device_of("render_forward", params.xyz_W)
    check_dtype("render_forward", torch.float32, **vars(params))
    with_hits = opaque_alpha is not None
    pose = packed(T_WC.to(device, torch.float32))
    splats, depth = project_rows(params, camera, pose, near_m, far_m)
    out = blank(camera, device, with_indices=with_indices, with_hits=with_hits)
    picture = CudaPicture(
        params=params,
        camera=camera,
        T_WC=pose,
        splats=splats,
        depth=depth,
        lists=list_tiles(splats, depth, camera, pixels),
        image={"rgb": out.rgb, "depth": out.depth_m, "alpha": out.alpha},
        pixels=as_bytes(pixels),
    )
    images = picture.image | {
        "first": out.first_index,
        "dominant": out.dominant_index,
        "hit": out.hit_index,
    }
    kernel = f"composite:composite_{int(with_indices)}{int(with_hits)}"
    opaque = float(opaque_alpha or _NO_HIT_ALPHA)
    launch("render_forward", kernel, picture.lists.n_tiles, _BLOCK, picture.work, images, opaque)
    return out, picture


def render_vjp(
    saved: Any,
    v_rgb: Tensor,
    v_depth_m: Tensor | None = None,
    v_alpha: Tensor | None = None,
    *,
    rows: Tensor | None = None,
    v_uv: Tensor | None = None,
    v_uv_abs: Tensor | None = None,
    v_conic: Tensor | None = None,
) -> GaussianParams:
    """See ``gsfusion_nb.render.render_vjp``.

    Raises:
        ValueError: tensors on several devices, a wrong mask.
    """
    gradients = {"v_rgb": v_rgb, "v_depth": v_depth_m, "v_alpha": v_alpha}
    device_of("render_vjp", v_rgb)
    seen = saved.image | {
        name: None if v is None else packed(v.float()) for name, v in gradients.items()
    }
    centres = {"v_uv": v_uv, "v_uv_abs": v_uv_abs, "v_conic": v_conic}
    return gradients_of(
        "render_vjp", "composite:composite_backward", saved, seen, rows=rows, **centres
    )
