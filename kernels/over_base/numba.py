"""``render_over_base`` and its gradient from the fused kernels: what ``gsfusion_nb.backends`` offers for CPU tensors.

Project and colour every row, then sum up; nothing is sorted. The gradient takes one splat after another, and its sums
go through the gradient of the projection, as in ``rasterize``. float64 runs on the reference.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfusion_nb.backends import Record
from gsfusion_nb.geometry import se3
from gsfusion_nb.render.over_base import Base, OverBaseOutput
from gsfusion_nb.types import Camera, GaussianParams

from ..binning.numba import tile_windows
from ..composite.layout import PAIR_SUMS
from ..project.geometry import centre_vjp, row_sums
from ..project.layout import SPLAT, Params, pack_camera
from ..project.numba import CHUNK, NOTED_PER_CHUNK, project_rows
from ..project.vjp import project_rows_vjp
from ..runtime.numba.launch import launching, scratch
from .backward import PLANES, gradient_planes, splat_sums
from .forward import Blended, Surface, blend_bands, list_bands, stride_of

_ALL_PIXELS = np.empty((0, 0), np.bool_)
_ALL_ROWS = np.empty(0, np.bool_)
_NAMES = ("xyz_W", "log_scale", "quat", "opacity_logit", "sh")


@dataclass(frozen=True, kw_only=True, eq=False)
class NumbaSaved(Record):
    """What the backward pass needs of the forward one."""

    backend = "numba"
    params: GaussianParams
    camera: Camera
    base: Base
    behind_m: float
    lens: np.ndarray
    splats: np.ndarray
    start: np.ndarray
    """Row i is drawn where ``start[i] < start[i + 1]``; its sums are then in row ``start[i]``."""
    image: Blended


def render_over_base(
    params: GaussianParams, camera: Camera, T_WC: Tensor, base: Base, *, behind_m: float
) -> tuple[OverBaseOutput, Any]:
    """See ``gsfusion_nb.render.render_over_base``."""
    T = T_WC.detach().double()
    cam = pack_camera(camera, se3.inverse(T).numpy(), T[:3, 3].numpy())
    N, H, W = len(params), camera.height, camera.width
    splats, count = np.empty((N, SPLAT), np.float32), np.empty(N, np.int32)
    rgb, depth_m, weight = (torch.empty(H, W, *n) for n in ((3,), (), ()))
    image = Blended(rgb.numpy(), depth_m.numpy(), weight.numpy())
    with launching():
        noted = scratch("noted_tiles", -(-N // CHUNK) * NOTED_PER_CHUNK).view(np.int32)
        project_rows(_arrays(params), cam, tile_windows(_ALL_PIXELS, W, H), splats, count, noted)
        start = np.zeros(N + 1, np.int32)
        np.cumsum(count > 0, out=start[1:])
        blend_bands(splats, list_bands(splats, start, H), _surface(base), np.float32(behind_m), image)
    saved = NumbaSaved(
        params=params,
        camera=camera,
        base=base,
        behind_m=behind_m,
        lens=cam,
        splats=splats,
        start=start,
        image=image,
    )
    return OverBaseOutput(rgb=rgb, depth_m=depth_m, weight=weight), saved


def render_over_base_vjp(
    saved: Any,
    v_rgb: Tensor,
    *,
    rows: Tensor | None = None,
    v_uv: Tensor | None = None,
    v_uv_abs: Tensor | None = None,
) -> GaussianParams:
    """See ``gsfusion_nb.render.render_over_base_vjp``."""
    trained = _ALL_ROWS if rows is None else rows.contiguous().numpy()
    out = {
        name: torch.empty_like(getattr(saved.params, name), memory_format=torch.contiguous_format) for name in _NAMES
    }
    H, W = saved.image.weight.shape
    drawn, stride = np.flatnonzero(np.diff(saved.start)).astype(np.int32), stride_of(W)
    with launching():
        planes = scratch("base_planes", PLANES * H * stride)
        sums = scratch("splat_sums", len(drawn) * PAIR_SUMS).reshape(-1, PAIR_SUMS)
        abs_sums = None if v_uv_abs is None else scratch("abs_sums", len(drawn) * 2).reshape(-1, 2)
        v_image = v_rgb.contiguous().numpy()
        behind = np.float32(saved.behind_m)
        gradient_planes(saved.image, _surface(saved.base), behind, v_image, planes.reshape(PLANES, H, stride))
        splat_sums(saved.splats, drawn, trained, planes, (H, W), sums, abs_sums)
        results = Params(*(out[name].numpy() for name in _NAMES))
        project_rows_vjp(_arrays(saved.params), saved.lens, saved.splats, saved.start, trained, sums, results)
        if v_uv is not None:
            packed = v_uv.contiguous()
            centre_vjp(saved.splats, saved.start, trained, sums, packed.numpy())
            v_uv.copy_(packed)
        if v_uv_abs is not None:
            packed = v_uv_abs.contiguous()
            row_sums(saved.start, trained, abs_sums, packed.numpy())
            v_uv_abs.copy_(packed)
    return GaussianParams(**out)


def _arrays(params: GaussianParams) -> Params:
    return Params(*(getattr(params, name).detach().contiguous().numpy() for name in _NAMES))


def _surface(base: Base) -> Surface:
    return Surface(*(image.detach().contiguous().numpy() for image in (base.rgb, base.depth_m, base.weight)))
