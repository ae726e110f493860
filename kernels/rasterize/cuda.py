"""``render_forward`` and ``render_vjp`` in CUDA, which ``gsfusion_nb.backends`` offers for CUDA tensors."""

from typing import Any, NamedTuple

from torch import Tensor

from gsfusion_nb.types import Camera, GaussianParams, RenderOutput

from ..binning.cuda import list_tiles
from ..project.cuda import project_rows, project_rows_vjp
from ..runtime.cuda.launch import device_of, launch
from . import host

_BLOCK = 128
_NO_HIT_ALPHA = 1.0


class CudaPicture(host.Picture):
    """What the backward pass needs of the forward one."""

    backend = "cuda"


class Work(NamedTuple):
    """What is to be composited, in which pixels (``None``: all)."""

    splats: Tensor
    ids: Tensor
    offset: Tensor
    pixels: Tensor | None
    width: int
    height: int
    tiles_x: int


class Images(NamedTuple):
    """What is to be written; indices that are not wanted are ``None``."""

    rgb: Tensor
    depth: Tensor
    alpha: Tensor
    first: Tensor | None
    dominant: Tensor | None
    hit: Tensor | None


class Seen(NamedTuple):
    """A picture and dL/d of it; ``None`` stands for zero."""

    rgb: Tensor
    depth: Tensor
    alpha: Tensor
    v_rgb: Tensor
    v_depth: Tensor | None
    v_alpha: Tensor | None


def render_forward(params: GaussianParams, camera: Camera, T_WC: Tensor, **options: Any) -> tuple[RenderOutput, Any]:
    """See ``gsfusion_nb.render.render_forward``. The pose may be on any device."""
    return host.render_forward(_KERNELS, params, camera, T_WC, **options)


def render_vjp(
    saved: Any,
    v_rgb: Tensor,
    v_depth_m: Tensor | None = None,
    v_alpha: Tensor | None = None,
    *,
    rows: Tensor | None = None,
) -> GaussianParams:
    """See ``gsfusion_nb.render.render_vjp``."""
    return host.render_vjp(_KERNELS, saved, v_rgb, v_depth_m, v_alpha, rows=rows)


def _work(picture: host.Picture) -> Work:
    lists, camera = picture.lists, picture.camera
    return Work(
        splats=picture.splats,
        ids=lists.ids,
        offset=lists.offset,
        pixels=picture.pixels,
        width=camera.width,
        height=camera.height,
        tiles_x=lists.grid.tiles_x,
    )


def _composite(picture: host.Picture, out: RenderOutput, opaque_alpha: float | None) -> None:
    images = Images(*picture.image, first=out.first_index, dominant=out.dominant_index, hit=out.hit_index)
    kernel = f"composite:composite_{int(images.first is not None)}{int(images.hit is not None)}"
    opaque = float(opaque_alpha or _NO_HIT_ALPHA)
    launch("render_forward", kernel, picture.lists.grid.n_tiles, _BLOCK, _work(picture), images, opaque)


def _composite_vjp(picture: host.Picture, v_image: host.ImageGradients, trained: Tensor | None, sums: Tensor) -> None:
    kernel, tiles = "composite:composite_backward", picture.lists.grid.n_tiles
    launch(
        "render_vjp", kernel, tiles, _BLOCK, _work(picture), Seen(*picture.image, **v_image._asdict()), trained, sums
    )


def _project_vjp(picture: host.Picture, sums: Tensor, trained: Tensor | None) -> GaussianParams:
    return project_rows_vjp(picture.params, picture.camera, picture.T_WC, picture.splats, picture.depth, sums, trained)


_KERNELS = host.Kernels(
    picture=CudaPicture,
    device_of=device_of,
    project=project_rows,
    list_tiles=list_tiles,
    composite=_composite,
    composite_vjp=_composite_vjp,
    project_vjp=_project_vjp,
)
