"""``render_forward`` and ``render_vjp`` in Triton, which ``gsfusion_nb.backends`` offers for CUDA tensors."""

from typing import Any

from torch import Tensor

from gsfusion_nb.types import Camera, GaussianParams, RenderOutput

from ..binning.triton import list_tiles
from ..composite.triton import STEP, TILE, composite_backward, composite_forward
from ..project.triton import project_rows, project_rows_vjp
from ..runtime.triton.launch import device_of, launch
from . import host

_OPTIONS = {"TILE": TILE, "STEP": STEP, "num_warps": TILE * TILE // 64}


class TritonPicture(host.Picture):
    """What the backward pass needs of the forward one."""

    backend = "triton"


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


def _work(picture: host.Picture) -> dict:
    """What is composited, in which pixels; a kernel reads no array that its options do not ask for."""
    rgb, depth, alpha = picture.image
    return {
        "splats": picture.splats,
        "ids": picture.lists.ids,
        "offset": picture.lists.offset,
        "pixels": picture.splats if picture.pixels is None else picture.pixels,
        "MASKED": picture.pixels is not None,
        "width": picture.camera.width,
        "height": picture.camera.height,
        "tiles_x": picture.lists.grid.tiles_x,
        "rgb": rgb,
        "depth": depth,
        "alpha_image": alpha,
    }


def _composite(picture: host.Picture, out: RenderOutput, opaque_alpha: float | None) -> None:
    indices = {"first": out.first_index, "dominant": out.dominant_index, "hit": out.hit_index}
    launch(
        composite_forward,
        picture.lists.grid.n_tiles,
        picture.splats.device,
        **_work(picture),
        **{f"{name}_image": out.depth_m if index is None else index for name, index in indices.items()},
        opaque_alpha=float(opaque_alpha or 1.0),
        INDICES=out.first_index is not None,
        HITS=out.hit_index is not None,
        **_OPTIONS,
    )


def _composite_vjp(
    picture: host.Picture, v_image: host.ImageGradients, trained: Tensor | None, v_splats: Tensor
) -> None:
    v_rgb, v_depth, v_alpha = v_image.v_rgb, v_image.v_depth, v_image.v_alpha
    launch(
        composite_backward,
        picture.lists.grid.n_tiles,
        picture.splats.device,
        **_work(picture),
        v_rgb=v_rgb,
        v_depth=v_rgb if v_depth is None else v_depth,
        v_alpha=v_rgb if v_alpha is None else v_alpha,
        trained=picture.splats if trained is None else trained,
        v_splats=v_splats,
        SOME=trained is not None,
        WITH_DEPTH=v_depth is not None,
        WITH_ALPHA=v_alpha is not None,
        **_OPTIONS,
    )


def _project_vjp(picture: host.Picture, v_splats: Tensor, trained: Tensor | None) -> GaussianParams:
    return project_rows_vjp(picture.params, picture.camera, picture.T_WC, picture.splats, v_splats, trained)


_KERNELS = host.Kernels(
    picture=TritonPicture,
    device_of=device_of,
    project=project_rows,
    list_tiles=list_tiles,
    composite=_composite,
    composite_vjp=_composite_vjp,
    project_vjp=_project_vjp,
)
