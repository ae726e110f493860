"""The whole renderer: project, colour, tile lists, composite; and its gradient, the stages in
reverse order."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..backends import Record, op
from ..checks import check_positive
from ..geometry.operands import MASK, check_gaussians, check_operand, check_view
from ..geometry.spherical_harmonics import sh_to_rgb, sh_to_rgb_vjp
from ..types import Camera, GaussianParams, RenderOutput
from .composite import check_image_gradients, check_record, composite, composite_vjp
from .on_screen import ScreenGaussians
from .project import pose_matrix_vjp, project_gaussians, project_gaussians_vjp
from .tiles import tile_intersections


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderSaved(Record):
    """What ``render_vjp`` needs from the forward pass. Every backend has its own kind of record."""

    params: GaussianParams
    camera: Camera
    T_WC: Float[Tensor, "4 4"]
    drawn: Bool[Tensor, " N"]
    """Rows that may be in the picture."""
    composite: Record
    screen: ScreenGaussians
    """What was blended."""


def render(params: GaussianParams, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RenderOutput:
    """Draw the Gaussian map from a camera: colour, blended depth, alpha, first and dominant
    Gaussian.

    Args:
        params: The map; any number of rows, even none; float32 or float64. A Gaussian whose centre,
            size, opacity or colour is NaN or infinite is not drawn and has zero gradient.
        camera: Pinhole camera, any image size.
        T_WC: Camera-to-world pose.

    Differentiable: use ``render_forward`` with ``render_vjp``, or ``render_autograd``.
    Source: Kerbl et al. 2023; the clamps and cuts, which are not in the paper, are in
    ``constants``.
    """
    return render_forward(params, camera, T_WC)[0]


def check_render(
    params: Any,
    camera: Any,
    T_WC: Any,
    *,
    with_indices: bool = True,
    opaque_alpha: float | None = None,
    pixels: Any = None,
) -> None:
    """Raise ``ValueError`` for arguments that ``render_forward`` refuses."""
    check_gaussians(params)
    check_view(camera, T_WC, params.xyz_W.device)
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
) -> None:
    """Raise ``ValueError`` for arguments that ``render_vjp`` refuses."""
    check_record(saved, "render_forward", "params")
    check_image_gradients(saved.camera, v_rgb, v_depth_m, v_alpha, saved.params.xyz_W.device)
    check_rows(saved.params.xyz_W, rows, v_uv=v_uv, v_uv_abs=v_uv_abs)


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

    Raises:
        ValueError: ``pixels`` is not boolean or not of the camera's size.
    """
    with torch.no_grad():
        T_WC = T_WC.to(params.xyz_W)
        projection = project_gaussians(params, camera, T_WC)
        is_drawn = projection.visible & params.sh.isfinite().all(2).all(1)
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

    Returns:
        Gradients, in the shape of the parameters; zero for a Gaussian that is not seen or is
        frozen.

    Raises:
        ValueError: ``rows`` is not boolean or not of the length of the parameters; ``v_uv`` or
            ``v_uv_abs`` is not [N, 2] of the parameters' type.
    """
    params = saved.params
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
    for target, value in ((v_uv, v.uv), (v_uv_abs, v.uv_abs)):
        if target is not None:
            target.copy_(value).masked_fill_(frozen[:, None], 0.0)
    return GaussianParams(**gradient)


class Render(torch.autograd.Function):
    """Binds ``render_forward``, ``render_vjp`` and ``pose_matrix_vjp`` to autograd; no arithmetic
    here."""

    @staticmethod
    def forward(ctx, camera, T_WC, xyz_W, log_scale, quat, opacity_logit, sh):
        params = GaussianParams(
            xyz_W=xyz_W, log_scale=log_scale, quat=quat, opacity_logit=opacity_logit, sh=sh
        )
        output, ctx.record = render_forward(params, camera, T_WC)
        # the check of saved tensors notices a change in place, also of the images, which a fast
        # record may share
        ctx.save_for_backward(
            T_WC,
            *vars(params).values(),
            output.rgb,
            output.depth_m,
            output.alpha,
        )
        ctx.mark_non_differentiable(output.first_index, output.dominant_index)
        return output.rgb, output.depth_m, output.alpha, output.first_index, output.dominant_index

    @staticmethod
    def backward(ctx, *v):
        if torch.is_grad_enabled():
            raise RuntimeError(
                "render_autograd has first derivatives only; expected a backward without "
                "create_graph"
            )
        T_WC, *columns = ctx.saved_tensors[:-3]
        g = render_vjp(ctx.record, *v[:3])
        params = GaussianParams(**dict(zip(vars(g), columns, strict=True)))
        v_T_WC = pose_matrix_vjp(params, g, T_WC) if ctx.needs_input_grad[1] else None
        return None, v_T_WC, g.xyz_W, g.log_scale, g.quat, g.opacity_logit, g.sh


def render_autograd(
    params: GaussianParams, camera: Camera, T_WC: Float[Tensor, "4 4"]
) -> RenderOutput:
    """``render`` for ``loss.backward()``, with the same arguments.

    Differentiable: once, in every parameter and in the pose. The gradient of ``T_WC`` is that of
    ``pose_matrix_vjp``: it is exact for every way to compute a rigid ``T_WC``, such as
    ``T_0 @ se3.exp(xi)`` or ``se3.inverse(T_CW)``. A matrix that is itself a leaf has to be moved
    along it as a rigid motion.

    Raises:
        RuntimeError: in a backward with ``create_graph``: there are no second derivatives; or after
            a parameter, the pose or a picture was changed in place since.
    """
    rgb, depth_m, alpha, first_index, dominant_index = Render.apply(
        camera, T_WC, params.xyz_W, params.log_scale, params.quat, params.opacity_logit, params.sh
    )  # pyright: ignore[reportGeneralTypeIssues]
    return RenderOutput(
        rgb=rgb,
        depth_m=depth_m,
        alpha=alpha,
        first_index=first_index,
        dominant_index=dominant_index,
    )
