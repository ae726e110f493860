"""Pictures of a map from one camera or several, with background and features, also for autograd.

Every backend draws colour over black. The rest follows from the blending weights w_k of a pixel:

    over a background b       C + (1 - alpha) b                         what is left of the light
    features f, any number    sum_k w_k f_k = sum_k w_k (f_k - m) + m alpha

Three channels of f - m take the place of the colour in a further picture, where m is below all
features, because a colour is not negative. Several cameras are one picture after the other. So a
fast backend is used for all of it, and F features cost as much as F / 3 pictures.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_finite, check_shape
from ..errors import ArgumentError
from ..geometry.operands import check_gaussians, check_operand
from ..geometry.spherical_harmonics import SH_C0
from ..types import Camera, GaussianParams, RenderOutput
from .constants import NEAR_PLANE_M
from .project import intrinsics_vjp, pose_matrix_vjp
from .rasterize import render_forward, render_vjp


def render(
    params: GaussianParams,
    camera: Camera | Sequence[Camera],
    T_WC: Float[Tensor, "*B 4 4"],
    *,
    background: Tensor | None = None,
    features: Tensor | None = None,
    near_m: float = NEAR_PLANE_M,
    far_m: float = math.inf,
) -> RenderOutput:
    """Draw the Gaussian map from one camera or several: colour, blended depth, alpha, first and
    dominant Gaussian, features.

    Args:
        params: The map; any number of rows, even none; float32 or float64. A Gaussian whose centre,
            size, opacity or colour is NaN or infinite is not drawn and has zero gradient.
        camera: Pinhole camera, any image size. With several poses: the camera of all of them, or
            one for each, of the same image size.
        T_WC: Camera-to-world pose, or one for each of B pictures. Images then begin with B.
        background: Colour behind the map, for all pictures [3] or for each [B, 3]; black by
            default.
        features: Further values of each Gaussian, blended like its colour, over 0. [N, F]
        near_m, far_m: Gaussians whose centre is not deeper than ``near_m``, or deeper than
            ``far_m``, are not drawn. Metres.

    Raises:
        ValueError: an argument of another shape, type or device; cameras of several image sizes;
            features that are not finite; ``far_m`` below ``near_m``.

    Differentiable: use ``render_forward`` with ``render_vjp``, or ``render_autograd``.
    Source: Kerbl et al. 2023; the clamps and cuts, which are not in the paper, are in
    ``constants``.
    """
    with torch.no_grad():
        return render_autograd(
            params,
            camera,
            T_WC,
            background=background,
            features=features,
            near_m=near_m,
            far_m=far_m,
        )


def render_autograd(
    params: GaussianParams,
    camera: Camera | Sequence[Camera],
    T_WC: Float[Tensor, "*B 4 4"],
    *,
    K: Tensor | None = None,
    background: Tensor | None = None,
    features: Tensor | None = None,
    near_m: float = NEAR_PLANE_M,
    far_m: float = math.inf,
) -> RenderOutput:
    """``render`` for ``loss.backward()``, with the same arguments and one more.

    Args:
        params, camera, T_WC, background, features, near_m, far_m: As given to ``render``.
        K: Intrinsic matrix [3, 3], or one for each picture [B, 3, 3], in place of the numbers of
            ``camera``, which then gives the image size only.

    Differentiable: once, in every parameter, the pose, the intrinsics, the background and the
    features. The gradient of ``T_WC`` is that of ``pose_matrix_vjp``: it is exact for every way to
    compute a rigid ``T_WC``, such as ``T_0 @ se3.exp(xi)`` or ``se3.inverse(T_CW)``. A matrix that
    is itself a leaf has to be moved along it as a rigid motion. ``K`` has a gradient in fx, fy, cx
    and cy.

    Raises:
        ValueError: As ``render``; or ``K`` has a skew.
        RuntimeError: in a backward with ``create_graph``: there are no second derivatives; or after
            a parameter, the pose or a picture was changed in place since.
    """
    check_gaussians(params)
    if features is not None:
        like = params.xyz_W
        check_operand(
            "features", features, (len(params), "F"), dtypes=(like.dtype,), device=like.device
        )
        check_finite("features", features)
    planes = (near_m, far_m)
    if not isinstance(T_WC, Tensor) or T_WC.ndim == 2:
        if not isinstance(camera, Camera):
            raise ArgumentError("several cameras need a pose for each: T_WC [B, 4, 4]")
        return _picture(params, camera, T_WC, K, background, features, planes)
    check_shape("T_WC", T_WC, ("B", 4, 4))
    cameras = _cameras(camera, len(T_WC))
    per_picture = zip(
        cameras,
        T_WC.unbind(0),
        _for_each("K", K, 2, len(T_WC)),
        _for_each("background", background, 1, len(T_WC)),
        strict=True,
    )
    pictures = [_picture(params, *given, features, planes) for given in per_picture]
    images: dict[str, Any] = {
        name: None if image is None else torch.stack([vars(p)[name] for p in pictures])
        for name, image in vars(pictures[0]).items()
    }
    return RenderOutput(**images)


class Render(torch.autograd.Function):
    """Binds ``render_forward``, ``render_vjp``, ``pose_matrix_vjp`` and ``intrinsics_vjp`` to
    autograd; no arithmetic here."""

    @staticmethod
    def forward(ctx, camera, planes, T_WC, K, xyz_W, log_scale, quat, opacity_logit, sh):
        params = GaussianParams(
            xyz_W=xyz_W, log_scale=log_scale, quat=quat, opacity_logit=opacity_logit, sh=sh
        )
        near_m, far_m = planes
        output, ctx.record = render_forward(params, camera, T_WC, near_m=near_m, far_m=far_m)
        ctx.camera = camera
        ctx.near_m = near_m
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
        needs_pose, needs_K = ctx.needs_input_grad[2:4]
        xyz_W = columns[0]
        on_screen = {}
        if needs_K:
            on_screen = {"v_uv": torch.empty_like(xyz_W[:, :2]), "v_conic": torch.empty_like(xyz_W)}
        g = render_vjp(ctx.record, *v[:3], **on_screen)
        params = GaussianParams(**dict(zip(vars(g), columns, strict=True)))
        v_T_WC = pose_matrix_vjp(params, g, T_WC) if needs_pose else None
        v_K = None
        if needs_K:
            v_numbers = intrinsics_vjp(params, ctx.camera, T_WC, **on_screen, near_m=ctx.near_m)
            v_K = v_numbers.new_zeros(3, 3)
            v_K[[0, 1, 0, 1], [0, 1, 2, 2]] = v_numbers
        return None, None, v_T_WC, v_K, g.xyz_W, g.log_scale, g.quat, g.opacity_logit, g.sh


def _picture(
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    K: Tensor | None,
    background: Tensor | None,
    features: Tensor | None,
    planes: tuple[float, float],
) -> RenderOutput:
    """One picture; arguments as for ``render_autograd``."""
    if K is not None:
        camera = _camera_of(K, camera)
    rgb, depth_m, alpha, first_index, dominant_index = Render.apply(
        camera, planes, T_WC, K, *vars(params).values()
    )  # pyright: ignore[reportGeneralTypeIssues]
    if background is not None:
        check_operand("background", background, (3,), dtypes=(rgb.dtype,), device=rgb.device)
        rgb = rgb + (1 - alpha)[..., None] * background
    blended = None
    if features is not None:
        blended = _blended(params, camera, T_WC, K, features, planes)
    return RenderOutput(
        rgb=rgb,
        depth_m=depth_m,
        alpha=alpha,
        first_index=first_index,
        dominant_index=dominant_index,
        features=blended,
    )


def _blended(
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    K: Tensor | None,
    features: Float[Tensor, "N F"],
    planes: tuple[float, float],
) -> Float[Tensor, "H W F"]:
    """The image of the features, three channels at a time."""
    if not features.shape[1]:
        return features.new_zeros(camera.height, camera.width, 0)
    # a Gaussian without a colour is not drawn
    has_colour = params.sh.isfinite().all(2).all(1)
    shift = features.detach().amin(0) - 1 if len(features) else features.new_zeros(1)
    colours = torch.where(has_colour[:, None], features - shift, torch.nan)
    images = []
    for three in colours.split(3, dim=1):
        padded = torch.nn.functional.pad(three, (0, 3 - three.shape[1]), value=1.0)
        sh = (padded - 0.5)[:, None] / SH_C0
        rgb, _, alpha, *_ = Render.apply(
            camera, planes, T_WC, K, *vars(dataclasses.replace(params, sh=sh)).values()
        )  # pyright: ignore[reportGeneralTypeIssues]
        images.append(rgb[..., : three.shape[1]])
    return torch.cat(images, dim=-1) + shift * alpha[..., None]


def _for_each(name: str, value: Tensor | None, n_axes: int, n: int) -> Sequence[Tensor | None]:
    """A value of ``n_axes`` axes for each of ``n`` pictures: the same, or those in ``value``."""
    if value is None or value.ndim <= n_axes:
        return [value] * n
    if len(value) != n:
        raise ArgumentError(f"{name} must be one for all pictures, or {n}, got {len(value)}")
    return value.unbind(0)


def _cameras(camera: Camera | Sequence[Camera], n: int) -> list[Camera]:
    """The cameras of ``n`` pictures, which must be of one size."""
    cameras = [camera] * n if isinstance(camera, Camera) else list(camera)
    if len(cameras) != n or not n:
        raise ArgumentError(
            f"several pictures need a pose for each camera, at least one; got {len(cameras)} "
            f"cameras and {n} poses"
        )
    sizes = sorted({(c.width, c.height) for c in cameras})
    if len(sizes) > 1:
        raise ArgumentError(
            "cameras of one call must have the same image size, got "
            f"{' and '.join(f'{w} x {h}' for w, h in sizes)}"
        )
    return cameras


def _camera_of(K: Tensor, camera: Camera) -> Camera:
    """The camera with the numbers of an intrinsic matrix."""
    check_operand("K", K, (3, 3))
    (fx, skew, cx), (zero, fy, cy), last = K.tolist()
    if skew or zero or last != [0.0, 0.0, 1.0]:
        raise ArgumentError(
            f"K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], without a skew, got {K.tolist()}"
        )
    return dataclasses.replace(camera, fx=fx, fy=fy, cx=cx, cy=cy)
