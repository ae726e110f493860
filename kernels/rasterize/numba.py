"""``render_forward`` and ``render_vjp`` from the fused kernels: what ``gsfusion_nb.backends``
offers for CPU tensors.

Project and colour every row, list its tiles, sort by counting, composite; and back. float64 goes to
the reference.
"""

# Arrays are passed on as a list, which pyright cannot follow:
# pyright: reportCallIssue=false

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfusion_nb.backends import Record
from gsfusion_nb.render.constants import NEAR_PLANE_M
from gsfusion_nb.render.on_screen import ScreenGaussians
from gsfusion_nb.types import Camera, GaussianParams, RenderOutput

from ..binning.layout import check_pairs
from ..binning.numba import depth_order, list_tiles, sort_pairs, tile_windows
from ..composite.backward import composite_backward
from ..composite.layout import PAIR_SUMS, TILE, Image, IndexImages, PairLists
from ..composite.numba import composite_forward
from ..project.gradients import gradients_of
from ..project.layout import pack_camera
from ..project.numba import project
from ..runtime.numba.launch import launching, scratch
from .host import blank, screen_of

_NO_IMAGE = np.empty((0, 0), np.float32)
_NO_INDEX = np.empty((0, 0), np.int64)
_ALL_PIXELS = np.empty((0, 0), np.bool_)
_ALL_ROWS = np.empty(0, np.bool_)


@dataclass(frozen=True, kw_only=True, eq=False)
class NumbaSaved(Record):
    """What the backward pass needs of the forward one."""

    backend = "numba"
    params: GaussianParams
    camera: Camera
    lens: np.ndarray
    splats: np.ndarray
    start: np.ndarray
    """Slots of row i in the lists: from ``start[i]`` to ``start[i + 1]``."""
    lists: PairLists
    image: Image
    pixels: np.ndarray

    @property
    def screen(self) -> ScreenGaussians:
        """What was blended."""
        splats, ids, offset = map(
            torch.from_numpy, (self.splats, self.lists.ids, self.lists.offset)
        )
        return screen_of(
            splats,
            ids,
            offset,
            self.camera,
            torch.from_numpy(self.pixels) if self.pixels.size else None,
        )


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
    """See ``gsfusion_nb.render.render_forward``."""
    pixel_list = (
        _ALL_PIXELS if pixels is None or bool(pixels.all()) else pixels.contiguous().numpy()
    )
    cam = pack_camera(camera, T_WC, near_m, far_m)
    N = len(params)
    H = camera.height
    W = camera.width
    output = blank(
        camera, torch.device("cpu"), with_indices=with_indices, with_hits=opaque_alpha is not None
    )
    image = Image(rgb=output.rgb.numpy(), depth=output.depth_m.numpy(), alpha=output.alpha.numpy())
    indices = (output.first_index, output.dominant_index, output.hit_index)
    indices = IndexImages(*(_NO_INDEX if index is None else index.numpy() for index in indices))
    with launching():
        tiles = tile_windows(pixel_list, W, H)
        splats, count, tile_notes = project(params, cam, tiles)
        check_pairs(int(count.sum(dtype=np.int64)))
        start = np.zeros(N + 1, np.int32)
        np.cumsum(count, out=start[1:])
        pair_tile = scratch("pair_tile", int(start[-1])).view(np.int32)
        list_tiles(splats, start, tile_notes, W, H, tiles.windows, pair_tile)
        order = depth_order(splats, count)
        lists = sort_pairs(order, start, pair_tile, -(-W // TILE) * -(-H // TILE))
        composite_forward(
            splats, lists, pixel_list, image, indices, np.float32(opaque_alpha or 1.0)
        )
    saved = NumbaSaved(
        params=params,
        camera=camera,
        lens=cam,
        splats=splats,
        start=start,
        lists=lists,
        image=image,
        pixels=pixel_list,
    )
    return output, saved


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
    """See ``gsfusion_nb.render.render_vjp``."""
    train_rows = _ALL_ROWS if rows is None else rows.contiguous().numpy()
    v_image = (
        _NO_IMAGE if v is None else v.contiguous().float().numpy()
        for v in (v_rgb, v_depth_m, v_alpha)
    )
    selection = (saved.pixels, train_rows)
    n_pairs = len(saved.lists.ids)
    with launching():
        pair_sums = scratch("pair_sums", n_pairs * PAIR_SUMS).reshape(-1, PAIR_SUMS)
        abs_sums = None if v_uv_abs is None else scratch("abs_sums", n_pairs * 2).reshape(-1, 2)
        composite_backward(
            saved.splats, saved.lists, selection, saved.image, Image(*v_image), pair_sums, abs_sums
        )
        return gradients_of(saved, train_rows, pair_sums, abs_sums, v_uv, v_uv_abs, v_conic)
