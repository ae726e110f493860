"""The whole renderer: project, colour, tile lists, composite; and its gradient, the stages in
reverse order."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..backends import Record, op
from ..checks import check_number, check_positive
from ..geometry.operands import MASK, check_gaussians, check_operand, check_view
from ..geometry.spherical_harmonics import sh_to_rgb, sh_to_rgb_vjp
from ..types import Camera, GaussianParams, RenderOutput
from .composite import check_image_gradients, check_record, composite, composite_vjp
from .constants import NEAR_PLANE_M
from .near_plane import near_plane_option
from .on_screen import ScreenGaussians
from .project import project_gaussians, project_gaussians_vjp
from .tiles import tile_intersections


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderSaved(Record):
    """What ``render_vjp`` needs from the forward pass. Every backend has its own kind of record."""

    params: GaussianParams
    camera: Camera
    T_WC: Float[Tensor, "4 4"]
    near_m: float
    drawn: Bool[Tensor, " N"]
    """Rows that may be in the picture."""
    composite: Record
    screen: ScreenGaussians
    """What was blended."""


def check_render(
    params: Any,
    camera: Any,
    T_WC: Any,
    *,
    with_indices: bool = True,
    opaque_alpha: float | None = None,
    pixels: Any = None,
    near_m: Any = NEAR_PLANE_M,
    far_m: Any = math.inf,
) -> None:
    """Raise ``ValueError`` for arguments that ``render_forward`` refuses."""
    check_gaussians(params)
    check_view(camera, T_WC, params.xyz_W.device)
    check_positive("near_m", near_m)
    if far_m != math.inf:
        check_number("far_m", far_m, near_m)
    if opaque_alpha is not None:
        check_positive("opaque_alpha", opaque_alpha)
    if pixels is not None:
        check_operand(
            "pixels",
            pixels,
            (camera.height, camera.width),
            dtypes=MASK,
            device=params.xyz_W.device,
        )


def check_render_vjp(
    saved: Any,
    v_rgb: Any,
    v_depth_m: Any = None,
    v_alpha: Any = None,
    *,
    rows: Any = None,
    v_uv: Any = None,
    v_uv_abs: Any = None,
    v_conic: Any = None,
) -> None:
    """Raise ``ValueError`` for arguments that ``render_vjp`` refuses."""
    check_record(saved, "render_forward", "params")
    like = saved.params.xyz_W
    check_image_gradients(saved.camera, v_rgb, v_depth_m, v_alpha, like.device)
    check_rows(like, rows, v_uv=v_uv, v_uv_abs=v_uv_abs)
    if v_conic is not None:
        check_operand("v_conic", v_conic, like.shape, dtypes=(like.dtype,), device=like.device)


def check_rows(like: Tensor, rows: Any, **centres: Any) -> None:
    """Raise ``ValueError`` unless the rows to train, and what is filled for the centres, fit those
    of ``like``."""
    if rows is not None:
        check_operand("rows", rows, (len(like),), dtypes=MASK, device=like.device)
    for name, target in centres.items():
        if target is not None:
            check_operand(
                name,
                target,
                (len(like), 2),
                dtypes=(like.dtype,),
                device=like.device,
            )


@op("rasterize", check_render)
def render_forward(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    *,
    with_indices: bool = True,
    opaque_alpha: float | None = None,
    pixels: Bool[Tensor, "H W"] | None = None,
    near_m: float = NEAR_PLANE_M,
    far_m: float = math.inf,
) -> tuple[RenderOutput, Record]:
    """``render``, and a record of the pass for ``render_vjp``. No autograd graph is made.

    Args:
        params, camera, T_WC: as given to ``render``.
        with_indices: Find the first and the dominant Gaussian of each pixel. An optimiser does not
            need them; with False both are ``None``, which is a little faster.
        opaque_alpha: If given, also find the Gaussians for ``disc_depth``; the paper's is
            ``OPAQUE_ALPHA``.
        pixels: Draw only where this is true; elsewhere all images are 0, indices -1 and gradients
            zero. Tiles without such a pixel take no time. (Peng et al. 2024, RTG-SLAM, section
            3.2.) [H, W]
        near_m, far_m: Gaussians whose centre is not deeper than ``near_m``, or deeper than
            ``far_m``, are not drawn. Metres.

    Raises:
        ValueError: ``pixels`` is not boolean or not of the camera's size; ``near_m`` is not above
            0, or ``far_m`` below it.
    """
    plane = near_plane_option(near_m)
    with torch.no_grad():
        T_WC = T_WC.to(params.xyz_W)
        projection = project_gaussians(params, camera, T_WC, **plane)
        is_drawn = projection.visible & params.sh.isfinite().all(2).all(1)
        is_drawn = is_drawn & (projection.depth_m <= far_m)
        projection = dataclasses.replace(projection, visible=is_drawn)
        rgb = torch.where(
            is_drawn[:, None],
            sh_to_rgb(params.sh, params.xyz_W, T_WC[:3, 3]),
            0.0,
        )
        tiles = tile_intersections(projection, camera, pixels=pixels)
        image = composite(
            projection.uv,
            projection.conic,
            projection.opacity,
            rgb,
            projection.depth_m,
            tiles,
            camera,
            with_indices=with_indices,
            opaque_alpha=opaque_alpha,
        )
    output = RenderOutput(
        rgb=image.rgb,
        depth_m=image.depth_m,
        alpha=image.alpha,
        first_index=image.first_index,
        dominant_index=image.dominant_index,
        hit_index=image.hit_index,
    )
    screen = ScreenGaussians(
        uv=projection.uv,
        conic=projection.conic,
        opacity=projection.opacity,
        rgb=rgb,
        depth_m=projection.depth_m,
        tiles=tiles,
    )
    return output, RenderSaved(
        params=params,
        camera=camera,
        T_WC=T_WC,
        near_m=near_m,
        drawn=is_drawn,
        composite=image.saved,
        screen=screen,
    )


@op("rasterize", check_render_vjp)
def render_vjp(
    saved: RenderSaved,
    v_rgb: Float[Tensor, "H W 3"],
    v_depth_m: Float[Tensor, "H W"] | None = None,
    v_alpha: Float[Tensor, "H W"] | None = None,
    *,
    rows: Bool[Tensor, " N"] | None = None,
    v_uv: Float[Tensor, "N 2"] | None = None,
    v_uv_abs: Float[Tensor, "N 2"] | None = None,
    v_conic: Float[Tensor, "N 3"] | None = None,
) -> GaussianParams:
    """dL/d of every parameter from dL/d of the images: the vjp of each stage, last stage first.

    Args:
        saved: Second result of ``render_forward``.
        v_rgb, v_depth_m, v_alpha: dL/d of the images; ``None`` is zero. Pixels that were not drawn
            are ignored.
        rows: Compute gradients only where this is true; the other Gaussians are frozen, which takes
            less time. [N]
        v_uv: If given, it is filled with dL/d of the centres in the image, per pixel, their size
            and shape in the image held fixed; densification decides by it (Kerbl et al. 2023,
            section 5.2). Zero as the other gradients are.
        v_uv_abs: If given, it is filled with the same sum over the pixels, but of absolute values:
            pixels that pull a Gaussian to opposite sides do not cancel (Ye et al. 2024, AbsGS).
            Zero as the other gradients are.
        v_conic: If given, it is filled with dL/d of the conics, which ``intrinsics_vjp`` needs
            besides ``v_uv``. Zero as the other gradients are.

    Returns:
        Gradients, in the shape of the parameters; zero for a Gaussian that is not seen or is
        frozen.

    Raises:
        ValueError: ``rows`` is not boolean or not of the length of the parameters; ``v_uv`` or
            ``v_uv_abs`` is not [N, 2] of the parameters' type, or ``v_conic`` not [N, 3].
    """
    params = saved.params
    plane = near_plane_option(saved.near_m)
    with torch.no_grad():
        v = composite_vjp(
            saved.composite, v_rgb, v_depth_m, v_alpha, with_uv_abs=v_uv_abs is not None
        )
        v_sh, v_xyz_W = sh_to_rgb_vjp(
            params.sh,
            params.xyz_W,
            saved.T_WC[:3, 3],
            v.rgb,
        )
        g = project_gaussians_vjp(
            params,
            saved.camera,
            saved.T_WC,
            v.uv,
            v.conic,
            v.depth_m,
            v.opacity,
            **plane,
        )
    gradient = {
        "xyz_W": g.xyz_W + v_xyz_W,  # the centre affects position and view direction
        "log_scale": g.log_scale,
        "quat": g.quat,
        "opacity_logit": g.opacity_logit,
        "sh": v_sh,
    }
    frozen = ~saved.drawn if rows is None else ~(saved.drawn & rows)
    for value in gradient.values():
        value[frozen] = 0.0
    for target, value in ((v_uv, v.uv), (v_uv_abs, v.uv_abs), (v_conic, v.conic)):
        if target is not None:
            target.copy_(value).masked_fill_(frozen[:, None], 0.0)
    return GaussianParams(**gradient)
