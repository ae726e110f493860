"""``render_forward`` and ``render_vjp`` in CUDA, which ``gsfusion_nb.backends`` offers for CUDA tensors.

Project and colour every row, list its tiles, sort, composite; and back. float64 goes to the reference. Gradients are
added up by atomics, in an order that changes from run to run: they repeat to rounding, not bit for bit.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsfusion_nb.backends import Record
from gsfusion_nb.render.on_screen import ScreenGaussians
from gsfusion_nb.types import Camera, GaussianParams, RenderOutput

from ..binning.cuda import TileLists, list_tiles
from ..project.cuda import centre_vjp, project_rows, project_rows_vjp
from ..project.layout import SPLAT
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
    def screen(self) -> ScreenGaussians:
        """What was blended."""
        shape, pixels = (self.camera.height, self.camera.width), self.pixels
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
) -> tuple[RenderOutput, Any]:
    """See ``gsfusion_nb.render.render_forward``. The pose may be on any device.

    Raises:
        ValueError: tensors on several devices or of several types, a wrong mask.
    """
    device = device_of("render_forward", **vars(params), pixels=pixels)
    check_dtype("render_forward", torch.float32, **vars(params))
    with_hits = opaque_alpha is not None
    pose = packed(T_WC.to(device, torch.float32))
    splats, depth = project_rows(params, camera, pose)
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
    images = picture.image | {"first": out.first_index, "dominant": out.dominant_index, "hit": out.hit_index}
    kernel = f"composite:composite_{int(with_indices)}{int(with_hits)}"
    opaque = float(opaque_alpha or _NO_HIT_ALPHA)
    launch("render_forward", kernel, picture.lists.n_tiles, _BLOCK, _work(picture), images, opaque)
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
) -> GaussianParams:
    """See ``gsfusion_nb.render.render_vjp``.

    Raises:
        ValueError: tensors on several devices, a wrong mask.
    """
    gradients = {"v_rgb": v_rgb, "v_depth": v_depth_m, "v_alpha": v_alpha}
    device = device_of("render_vjp", picture=saved.splats, rows=rows, **gradients)
    seen = saved.image | {name: None if v is None else packed(v.float()) for name, v in gradients.items()}
    trained = as_bytes(rows)
    sums = torch.zeros(len(saved.splats), SPLAT, dtype=torch.float32, device=device)
    kernel, tiles = "composite:composite_backward", saved.lists.n_tiles
    if v_uv_abs is None:
        launch("render_vjp", kernel, tiles, _BLOCK, _work(saved), seen, trained, sums)
    else:
        abs_sums = torch.zeros(len(saved.splats), 2, dtype=torch.float32, device=device)
        launch("render_vjp", f"{kernel}_abs", tiles, _BLOCK, _work(saved), seen, trained, sums, abs_sums)
        v_uv_abs.copy_(abs_sums)
    if v_uv is not None:
        centre_vjp(saved.splats, saved.depth, sums, rows, v_uv)
    return project_rows_vjp(saved.params, saved.camera, saved.T_WC, saved.splats, saved.depth, sums, trained)


def _work(picture: CudaPicture) -> dict[str, Any]:
    return picture.lists.work(picture.splats, picture.camera, picture.pixels)
