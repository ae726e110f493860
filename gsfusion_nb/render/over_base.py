"""Gaussians over a picture of the surface, blended without order (GPS-SLAM), and the gradient.

The base is what a camera sees of the coloured surface: a colour C_s and a depth D_s for each pixel,
with the weight b. For pixel u and Gaussian i, with its alpha as in ``composite`` and z_i the depth
of its centre:

    w_i = alpha_i,  0 where z_i > D_s + eps      the Gaussian is behind the surface             (1)
    W   = sum_i w_i                              not bounded by 1                               (2)
    C   = (b C_s + sum_i w_i c_i) / (b + W)      a weighted mean; the base is one more sample   (3)

Sums do not depend on an order: nothing is sorted, no light is used up, no pixel is finished early.
Where D_s = 0 there is no surface, and (1) hides nothing. With v_C = dL/dC of one pixel and
everything but the Gaussians held fixed:

    q         = v_C / (b + W)                    dL/d of the sum in (3)                         (4)
    dL/dc_i   = w_i q                                                                           (5)
    dL/dw_i   = q . (c_i - C)                    since dC/dw_i = (c_i - C) / (b + W)            (6)

and from w_i on the gradient of alpha, as in ``composite``.

Source: Peng et al. 2025 (GPS-SLAM) and its released code, where b = 1; the form is that of Ye et
al. 2025 (Gaussian-enhanced surfels). The release cuts alpha at 0.999, here it is cut at 0.99 as in
the rest of the toolkit.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..backends import Record, op, piece
from ..checks import check_number, check_positive
from ..errors import ArgumentError
from ..geometry.operands import check_gaussians, check_operand, check_view
from ..geometry.spherical_harmonics import sh_to_rgb, sh_to_rgb_vjp
from ..types import Camera, GaussianParams, RenderOutput
from .composite import absolute_uv_vjp, check_record, pixel_offsets, splat_alpha, splat_alpha_vjp
from .constants import ALPHA_MAX, NEAR_PLANE_M
from .near_plane import near_plane_option
from .on_screen import ScreenGaussians
from .project import project_gaussians, project_gaussians_vjp
from .rasterize import check_rows
from .tiles import tile_intersections


@dataclass(frozen=True, kw_only=True, eq=False)
class Base:
    """The surface as a camera sees it, the picture over which the Gaussians are blended. It has no
    gradient."""

    rgb: Float[Tensor, "H W 3"]
    """C_s."""
    depth_m: Float[Tensor, "H W"]
    """D_s: z-depth, metres; 0 where no surface is known."""
    weight: Float[Tensor, "H W"]
    """b: how much C_s counts against the Gaussians; 0: not at all, 1: as much as one opaque
    Gaussian."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OverBaseOutput:
    """Base and Gaussians together."""

    rgb: Float[Tensor, "H W 3"]
    """C; not clamped. 0 where b + W = 0."""
    depth_m: Float[Tensor, "H W"]
    """(D_s + sum w_i z_i) / (1 + W); without the surface where there is none; 0 where there is
    nothing at all."""
    weight: Float[Tensor, "H W"]
    """W, the sum of the Gaussians' weights; may exceed 1."""

    def as_render_output(self, base: Base) -> RenderOutput:
        """The picture as mappers show it: alpha is 1 where ``base`` has a surface, else W, at most
        1; no indices."""
        alpha = torch.where(
            base.depth_m > 0,
            1.0,
            self.weight.clamp(max=1.0),
        )
        return RenderOutput(
            rgb=self.rgb,
            depth_m=alpha * self.depth_m,
            alpha=alpha,
            first_index=None,
            dominant_index=None,
            surface_depth_m=base.depth_m,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class OverBaseSaved(Record):
    """What ``render_over_base_vjp`` needs from the forward pass. Every backend has its own kind of
    record."""

    params: GaussianParams
    camera: Camera
    T_WC: Float[Tensor, "4 4"]
    base: Base
    behind_m: float
    near_m: float
    drawn: Bool[Tensor, " N"]
    screen: ScreenGaussians
    output: OverBaseOutput


def check_over_base(
    params: Any,
    camera: Any,
    T_WC: Any,
    base: Any,
    *,
    behind_m: float,
    near_m: Any = NEAR_PLANE_M,
) -> None:
    """Raise ``ValueError`` for arguments that ``render_over_base`` refuses."""
    check_gaussians(params)
    check_view(camera, T_WC, params.xyz_W.device)
    if not isinstance(base, Base):
        raise ArgumentError(f"base must be a Base, got {type(base).__name__}")
    size = (camera.height, camera.width)
    like = params.xyz_W
    for name, shape in (("rgb", (*size, 3)), ("depth_m", size), ("weight", size)):
        check_operand(
            f"base.{name}",
            getattr(base, name),
            shape,
            dtypes=(like.dtype,),
            device=like.device,
        )
    check_number("behind_m", behind_m, 0)
    check_positive("near_m", near_m)


def check_over_base_vjp(
    saved: Any,
    v_rgb: Any,
    *,
    rows: Any = None,
    v_uv: Any = None,
    v_uv_abs: Any = None,
) -> None:
    """Raise ``ValueError`` for arguments that ``render_over_base_vjp`` refuses."""
    check_record(saved, "render_over_base", "behind_m")
    like = saved.params.xyz_W
    camera = saved.camera
    check_operand(
        "v_rgb",
        v_rgb,
        (camera.height, camera.width, 3),
        dtypes=(like.dtype,),
        device=like.device,
    )
    check_rows(like, rows, v_uv=v_uv, v_uv_abs=v_uv_abs)


@op("over_base", check_over_base)
def render_over_base(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    base: Base,
    *,
    behind_m: float,
    near_m: float = NEAR_PLANE_M,
) -> tuple[OverBaseOutput, Record]:
    """Draw the Gaussians over ``base``, and a record of the pass for ``render_over_base_vjp``.

    Args:
        params: The map, any number of rows; rows with NaN or infinities are not drawn.
        camera, T_WC: The camera and its camera-to-world pose.
        base: What this camera sees of the surface.
        behind_m: eps of (1): a Gaussian whose centre is farther than this behind the surface is
            hidden, metres.
        near_m: Gaussians whose centre is not deeper than this are not drawn, metres.

    Differentiable: ``render_over_base_vjp``, in the parameters of the Gaussians.
    """
    with torch.no_grad():
        T_WC = T_WC.to(params.xyz_W)
        projection = project_gaussians(params, camera, T_WC, **near_plane_option(near_m))
        is_drawn = projection.visible & params.sh.isfinite().all(2).all(1)
        projection = dataclasses.replace(projection, visible=is_drawn)
        screen = ScreenGaussians(
            uv=projection.uv,
            conic=projection.conic,
            opacity=projection.opacity,
            rgb=torch.where(
                is_drawn[:, None], sh_to_rgb(params.sh, params.xyz_W, T_WC[:3, 3]), 0.0
            ),
            depth_m=projection.depth_m,
            tiles=tile_intersections(projection, camera),
        )
        rgb, depth_m, weight = (
            torch.zeros_like(image) for image in (base.rgb, base.depth_m, base.weight)
        )
        for tile in range(screen.tiles.tiles_x * screen.tiles.tiles_y):
            k = screen.tiles.gaussians_of(tile)
            y, x = screen.tiles.pixels_of(tile, camera)
            _, w = weights_in_front(screen, k, x, y, base, behind_m)
            rgb[y, x], weight[y, x] = blend_with_base(
                w,
                screen.rgb[k],
                base.rgb[y, x],
                base.weight[y, x],
            )
            has_surface = base.depth_m[y, x] > 0
            D = torch.where(has_surface, base.depth_m[y, x], 0.0)
            depth_m[y, x] = _ratio(D + w.T @ screen.depth_m[k], has_surface + w.sum(0))
    output = OverBaseOutput(rgb=rgb, depth_m=depth_m, weight=weight)
    return output, OverBaseSaved(
        params=params,
        camera=camera,
        T_WC=T_WC,
        base=base,
        behind_m=behind_m,
        near_m=near_m,
        drawn=is_drawn,
        screen=screen,
        output=output,
    )


@op("over_base", check_over_base_vjp)
def render_over_base_vjp(
    saved: OverBaseSaved,
    v_rgb: Float[Tensor, "H W 3"],
    *,
    rows: Bool[Tensor, " N"] | None = None,
    v_uv: Float[Tensor, "N 2"] | None = None,
    v_uv_abs: Float[Tensor, "N 2"] | None = None,
) -> GaussianParams:
    """dL/d of every parameter from dL/d of the colour.

    Args:
        saved: Second result of ``render_over_base``.
        v_rgb: dL/dC.
        rows, v_uv, v_uv_abs: As for ``render_vjp``.

    Returns:
        Gradients, in the shape of the parameters; zero for a Gaussian that is not seen or is
        frozen.
    """
    params = saved.params
    screen = saved.screen
    camera = saved.camera
    base = saved.base
    v = {
        name: torch.zeros_like(getattr(screen, name)) for name in ("uv", "conic", "opacity", "rgb")
    }
    v_abs = torch.zeros_like(screen.uv)
    with torch.no_grad():
        for tile in range(screen.tiles.tiles_x * screen.tiles.tiles_y):
            k = screen.tiles.gaussians_of(tile)
            y, x = screen.tiles.pixels_of(tile, camera)
            alpha, w = weights_in_front(screen, k, x, y, base, saved.behind_m)
            C = saved.output.rgb[y, x]
            b = base.weight[y, x]
            v_w, v_c = blend_with_base_vjp(
                w,
                screen.rgb[k],
                C,
                b,
                v_rgb[y, x],
            )
            # w = alpha, 0 where hidden: (1)
            v_alpha = torch.where((w > 0) & (alpha < ALPHA_MAX), v_w, 0.0)
            dx, dy = pixel_offsets(screen.uv[k], x, y)
            conic = screen.conic[k]
            v_uv_k, v_conic_k, v_opacity_k = splat_alpha_vjp(
                dx, dy, conic, screen.opacity[k], alpha, v_alpha
            )
            v["uv"][k] += v_uv_k
            v["conic"][k] += v_conic_k
            v["opacity"][k] += v_opacity_k
            v["rgb"][k] += v_c
            if v_uv_abs is not None:
                v_abs[k] += absolute_uv_vjp(dx, dy, conic, alpha, v_alpha)
        v_sh, v_xyz_W = sh_to_rgb_vjp(
            params.sh,
            params.xyz_W,
            saved.T_WC[:3, 3],
            v["rgb"],
        )
        no_depth = torch.zeros_like(screen.depth_m)
        g = project_gaussians_vjp(
            params,
            camera,
            saved.T_WC,
            v["uv"],
            v["conic"],
            no_depth,
            v["opacity"],
            **near_plane_option(saved.near_m),
        )
    gradient = vars(g) | {"xyz_W": g.xyz_W + v_xyz_W, "sh": v_sh}
    frozen = ~saved.drawn if rows is None else ~(saved.drawn & rows)
    for value in gradient.values():
        value[frozen] = 0.0
    for target, value in ((v_uv, v["uv"]), (v_uv_abs, v_abs)):
        if target is not None:
            target.copy_(value).masked_fill_(frozen[:, None], 0.0)
    return GaussianParams(**gradient)


def weights_in_front(
    screen: ScreenGaussians, k: Tensor, x: Tensor, y: Tensor, base: Base, behind_m: float
) -> tuple[Float[Tensor, "K P"], Float[Tensor, "K P"]]:
    """alpha and w of the Gaussians ``k`` at the pixels in columns ``x`` and rows ``y``."""
    dx, dy = pixel_offsets(screen.uv[k], x, y)
    alpha = splat_alpha(dx, dy, screen.conic[k], screen.opacity[k])
    return alpha, not_behind(
        alpha,
        screen.depth_m[k],
        base.depth_m[y, x],
        behind_m,
    )


@piece
def not_behind(
    alpha: Float[Tensor, "K P"],
    z: Float[Tensor, " K"],
    D_s: Float[Tensor, " P"],
    behind_m: float,
) -> Float[Tensor, "K P"]:
    """Weights of K Gaussians at depths ``z`` at P pixels with the surface at depths ``D_s``, 0 for
    no surface."""
    hidden = (D_s > 0) & (z[:, None] > D_s + behind_m)
    return torch.where(hidden, 0.0, alpha)  # (1)


@piece
def blend_with_base(
    w: Float[Tensor, "K P"],
    c: Float[Tensor, "K 3"],
    C_s: Float[Tensor, "P 3"],
    b: Float[Tensor, " P"],
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, " P"]]:
    """Colour C and weight W of P pixels from the weights and colours of K Gaussians, in any order,
    and the base."""
    W = w.sum(0)  # (2)
    C = _ratio(
        b[:, None] * C_s + w.T @ c,
        (b + W)[:, None],
    )  # (3)
    return C, W


@piece
def blend_with_base_vjp(
    w: Float[Tensor, "K P"],
    c: Float[Tensor, "K 3"],
    C: Float[Tensor, "P 3"],
    b: Float[Tensor, " P"],
    v_C: Float[Tensor, "P 3"],
) -> tuple[Float[Tensor, "K P"], Float[Tensor, "K 3"]]:
    """Gradient of ``blend_with_base``, whose result is ``C``, to the weights and colours: v_w and
    v_c."""
    W = w.sum(0)
    q = _ratio(v_C, (b + W)[:, None])  # (4)
    v_c = w @ q  # (5)
    v_w = c @ q.T - (q * C).sum(1)  # (6)
    return v_w, v_c


def _ratio(a: Tensor, b: Tensor) -> Tensor:
    """a / b, and 0 where b is 0: a pixel that nothing has any weight in."""
    return torch.where(
        b > 0,
        a / torch.where(b > 0, b, 1.0),
        0.0,
    )
