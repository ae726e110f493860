"""Front-to-back blending of the sorted Gaussians of each tile, and its gradient.

For the k-th Gaussian of a pixel, nearest first, with (dx, dy) = pixel centre - (u, v):

    sigma_k = (A dx^2 + C dy^2) / 2 + B dx dy
    alpha_k = min(0.99, o_k exp(-sigma_k)),  0 where that is below 1/255
    T_k     = prod_{j<k} (1 - alpha_j)        the light that is left
    w_k     = alpha_k T_k,  0 from the first k on with T_{k+1} < 1e-4
    C       = sum_k w_k c_k,  c = (r, g, b, z, 1): colour, depth and alpha are blended alike

    dL/dc_k     = w_k v_C
    dL/dalpha_k = T_k (c_k . v_C) - S_k / (1 - alpha_k),   S_k = sum_{j>k} w_j (c_j . v_C)
    dL/du_k     = sum_pixels alpha_k dL/dalpha_k (A dx + B dy)
    dL/dv_k     = sum_pixels alpha_k dL/dalpha_k (B dx + C dy)

Where the pixels of a Gaussian pull it to opposite sides, the terms of the last sums cancel. The
sums of their absolute values, ``uv_abs``, do not cancel: sum_pixels |alpha_k dL/dalpha_k (A dx + B
dy)|, and the same for v.

Source: Kerbl et al. 2023, Eq. 3-4 and section 6 (0.99, 1/255, 1e-4); RTG-SLAM Eq. 1-3; GSFusion Eq.
3 and 11; ``uv_abs``: Ye et al. 2024 (AbsGS).

Arrays are [K, P]: the K Gaussians of a tile, nearest first, at its P pixels.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import Record, op, piece
from ..checks import check_positive
from ..errors import ArgumentError
from ..geometry.operands import check_camera, check_operand
from ..types import Camera
from .constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from .tiles import TileLists


@dataclass(frozen=True, kw_only=True, eq=False)
class CompositeSaved(Record):
    """What ``composite_vjp`` needs from the forward pass: its inputs."""

    uv: Float[Tensor, "N 2"]
    conic: Float[Tensor, "N 3"]
    opacity: Float[Tensor, " N"]
    c: Float[Tensor, "N 5"]
    """r, g, b, z, 1 of each Gaussian."""
    tiles: TileLists
    camera: Camera


@dataclass(frozen=True, kw_only=True, eq=False)
class CompositeOutput:
    """The blended image."""

    rgb: Float[Tensor, "H W 3"]
    """Colour over black."""
    depth_m: Float[Tensor, "H W"]
    """sum_k w_k z_k, metres."""
    alpha: Float[Tensor, "H W"]
    """sum_k w_k = 1 - transmittance."""
    first_index: Int[Tensor, "H W"] | None
    """Row of the first Gaussian with w > 0, or -1. ``None`` if not asked for."""
    dominant_index: Int[Tensor, "H W"] | None
    """Row of the Gaussian with the largest w (the nearest of equals), or -1. ``None`` if not asked
    for."""
    hit_index: Int[Tensor, "H W"] | None
    """Row of the first Gaussian with alpha >= ``opaque_alpha``, blended or not, or -1. ``None`` if
    not asked for."""
    saved: Record


@dataclass(frozen=True, kw_only=True, eq=False)
class CompositeGradient:
    """dL/d of the screen-space Gaussians."""

    uv: Float[Tensor, "N 2"]
    conic: Float[Tensor, "N 3"]
    opacity: Float[Tensor, " N"]
    rgb: Float[Tensor, "N 3"]
    depth_m: Float[Tensor, " N"]
    uv_abs: Float[Tensor, "N 2"] | None = None
    """The sum over pixels of the absolute values of dL/du and dL/dv. ``None`` if not asked for."""


def check_composite(
    uv: Any,
    conic: Any,
    opacity: Any,
    rgb: Any,
    depth_m: Any,
    tiles: Any,
    camera: Any,
    *,
    with_indices: bool = True,
    opaque_alpha: float | None = None,
) -> None:
    """Raise ``ValueError`` for arguments that ``composite`` refuses, such as the lists of another
    scene or image."""
    check_operand("uv", uv, ("N", 2))
    n = len(uv)
    columns = {
        "conic": (conic, (n, 3)),
        "opacity": (opacity, (n,)),
        "rgb": (rgb, (n, 3)),
        "depth_m": (depth_m, (n,)),
    }
    for name, (value, shape) in columns.items():
        check_operand(name, value, shape, dtypes=(uv.dtype,), device=uv.device)
    if not isinstance(tiles, TileLists):
        raise ArgumentError(
            f"tiles must be TileLists, as tile_intersections makes them, got {type(tiles).__name__}"
        )
    check_camera(camera)
    tiles.check(n, camera)
    if opaque_alpha is not None:
        check_positive("opaque_alpha", opaque_alpha)


def check_image_gradients(
    camera: Camera, v_rgb: Any, v_depth_m: Any, v_alpha: Any, device: torch.device
) -> None:
    """Raise ``ValueError`` unless the gradients of the images have the camera's size."""
    size = (camera.height, camera.width)
    check_operand("v_rgb", v_rgb, (*size, 3), device=device)
    for name, value in (("v_depth_m", v_depth_m), ("v_alpha", v_alpha)):
        if value is not None:
            check_operand(name, value, size, device=device)


def check_record(saved: Any, maker: str, field: str) -> None:
    """Raise ``ValueError`` unless this is the record that operation ``maker`` returns, which has a
    ``field``."""
    if not issubclass(type(saved), Record) or not hasattr(saved, field):
        raise ArgumentError(
            f"saved: the record that {maker} returns was expected, got {type(saved).__name__}"
        )


def check_composite_vjp(
    saved: Any,
    v_rgb: Any,
    v_depth_m: Any = None,
    v_alpha: Any = None,
    *,
    with_uv_abs: bool = False,
) -> None:
    """Raise ``ValueError`` for arguments that ``composite_vjp`` refuses."""
    check_record(saved, "composite", "tiles")
    check_image_gradients(saved.camera, v_rgb, v_depth_m, v_alpha, saved.opacity.device)


@op("composite", check_composite)
def composite(
    uv: Float[Tensor, "N 2"],
    conic: Float[Tensor, "N 3"],
    opacity: Float[Tensor, " N"],
    rgb: Float[Tensor, "N 3"],
    depth_m: Float[Tensor, " N"],
    tiles: TileLists,
    camera: Camera,
    *,
    with_indices: bool = True,
    opaque_alpha: float | None = None,
) -> CompositeOutput:
    """Blend the Gaussians of ``tiles`` over black (equations at the top of this file).

    Args:
        uv, conic, opacity, depth_m: Screen-space Gaussians as in ``Projection``; rows not in
            ``tiles`` are not drawn.
        rgb: Colour of each. [N, 3]
        tiles: Sorted lists; they decide what is drawn, in which order, and on which pixels.
        camera: Gives the image size.
        with_indices: Also find the first and the dominant Gaussian of each pixel.
        opaque_alpha: If given, also find the first Gaussian whose alpha at the pixel reaches it,
            even behind the point where the pixel stops (RTG-SLAM, section 3.1).

    Differentiable: ``composite_vjp``.
    """
    c = torch.cat(
        [rgb, depth_m[:, None], torch.ones_like(depth_m)[:, None]],
        dim=1,
    )
    C = uv.new_zeros(camera.height, camera.width, 5)
    first, dominant, hit_index = (tiles.gaussian.new_full(C.shape[:2], -1) for _ in range(3))
    for tile in range(tiles.tiles_x * tiles.tiles_y):
        k = tiles.gaussians_of(tile)
        y, x = tiles.pixels_of(tile, camera)
        if len(k) == 0:
            continue
        dx, dy = pixel_offsets(uv[k], x, y)
        alpha = splat_alpha(dx, dy, conic[k], opacity[k])
        w, C[y, x] = blend(alpha, c[k])
        first[y, x] = _nearest(w > 0, k)
        dominant[y, x] = _nearest((w > 0) & (w == w.amax(dim=0)), k)
        if opaque_alpha is not None:
            hit_index[y, x] = _nearest(
                alpha >= opaque_alpha, k
            )  # the Gaussian that the ray meets: RTG-SLAM, above Eq. 4
    return CompositeOutput(
        rgb=C[..., :3],
        depth_m=C[..., 3],
        alpha=C[..., 4],
        first_index=first if with_indices else None,
        dominant_index=dominant if with_indices else None,
        hit_index=None if opaque_alpha is None else hit_index,
        saved=CompositeSaved(uv=uv, conic=conic, opacity=opacity, c=c, tiles=tiles, camera=camera),
    )


@op("composite", check_composite_vjp)
def composite_vjp(
    saved: CompositeSaved,
    v_rgb: Float[Tensor, "H W 3"],
    v_depth_m: Float[Tensor, "H W"] | None = None,
    v_alpha: Float[Tensor, "H W"] | None = None,
    *,
    with_uv_abs: bool = False,
) -> CompositeGradient:
    """Gradient of ``composite`` with respect to everything that it blends (equations at the top of
    this file).

    It is the exact derivative of the forward pass: zero where alpha is clamped at 0.99 or cut at
    1/255. (The code released with Kerbl et al. 2023 lets the gradient through the 0.99 clamp.)

    Args:
        saved: ``CompositeOutput.saved``.
        v_rgb, v_depth_m, v_alpha: dL/d of the images; ``None`` is zero. Pixels that were not drawn
            are ignored.
        with_uv_abs: Also sum up the absolute values of the pixels' dL/du and dL/dv.
    """
    uv = saved.uv
    conic = saved.conic
    opacity = saved.opacity
    c = saved.c
    v_depth_m, v_alpha = (
        torch.zeros_like(v_rgb[..., 0]) if v is None else v for v in (v_depth_m, v_alpha)
    )
    v_image = torch.cat(
        [v_rgb, v_depth_m[..., None], v_alpha[..., None]],
        dim=-1,
    )
    v_uv, v_conic, v_opacity, v_c = (torch.zeros_like(value) for value in (uv, conic, opacity, c))
    v_uv_abs = torch.zeros_like(uv) if with_uv_abs else None
    for tile in range(saved.tiles.tiles_x * saved.tiles.tiles_y):
        k = saved.tiles.gaussians_of(tile)
        y, x = saved.tiles.pixels_of(tile, saved.camera)
        dx, dy = pixel_offsets(uv[k], x, y)
        alpha = splat_alpha(dx, dy, conic[k], opacity[k])
        v_alpha_k, v_c_k = blend_vjp(alpha, c[k], v_image[y, x])
        v_uv_k, v_conic_k, v_opacity_k = splat_alpha_vjp(
            dx, dy, conic[k], opacity[k], alpha, v_alpha_k
        )
        v_c[k] += v_c_k
        v_uv[k] += v_uv_k
        v_conic[k] += v_conic_k
        v_opacity[k] += v_opacity_k
        if v_uv_abs is not None:
            v_uv_abs[k] += absolute_uv_vjp(dx, dy, conic[k], alpha, v_alpha_k)
    return CompositeGradient(
        uv=v_uv,
        conic=v_conic,
        opacity=v_opacity,
        rgb=v_c[:, :3],
        depth_m=v_c[:, 3],
        uv_abs=v_uv_abs,
    )


def pixel_offsets(
    uv: Tensor, x: Tensor, y: Tensor
) -> tuple[Float[Tensor, "K P"], Float[Tensor, "K P"]]:
    """dx and dy, pixel centre - (u, v), of K Gaussians at the pixels in columns ``x`` and rows
    ``y``."""
    return x + 0.5 - uv[:, :1], y + 0.5 - uv[:, 1:]


@piece
def splat_alpha(
    dx: Float[Tensor, "K P"],
    dy: Float[Tensor, "K P"],
    conic: Float[Tensor, "K 3"],
    opacity: Float[Tensor, " K"],
) -> Float[Tensor, "K P"]:
    """alpha of K Gaussians at P pixels (RTG-SLAM Eq. 2): at most 0.99, and 0 below 1/255."""
    A, B, C = conic[:, :, None].unbind(1)
    # (u - mu)^T Sigma'^-1 (u - mu) / 2
    sigma = (A * dx * dx + C * dy * dy) / 2 + B * dx * dy  # GSFusion Eq. 3
    alpha = (opacity[:, None] * torch.exp(-sigma)).clamp(max=ALPHA_MAX)  # RTG-SLAM Eq. 2
    return torch.where(alpha >= ALPHA_MIN, alpha, 0.0)


@piece
def splat_alpha_vjp(
    dx: Float[Tensor, "K P"],
    dy: Float[Tensor, "K P"],
    conic: Float[Tensor, "K 3"],
    opacity: Float[Tensor, " K"],
    alpha: Float[Tensor, "K P"],
    v_alpha: Float[Tensor, "K P"],
) -> tuple[Float[Tensor, "K 2"], Float[Tensor, "K 3"], Float[Tensor, " K"]]:
    """Gradient of ``splat_alpha``, whose result is ``alpha``: v_uv, v_conic and v_opacity, summed
    over the pixels.

    ``v_alpha`` is zero where alpha is clamped or cut.
    """
    # alpha = o exp(-sigma)
    v_opacity = (v_alpha * alpha).sum(1) / opacity
    v_sigma = -v_alpha * alpha
    # sigma = (A dx^2 + C dy^2) / 2 + B dx dy,  (dx, dy) = pixel centre - (u, v)
    A, B, C = conic[:, :, None].unbind(1)
    v_uv = -torch.stack(
        [v_sigma * (A * dx + B * dy), v_sigma * (B * dx + C * dy)],
        dim=1,
    ).sum(2)
    v_conic = torch.stack(
        [v_sigma * dx * dx / 2, v_sigma * dx * dy, v_sigma * dy * dy / 2],
        dim=1,
    ).sum(2)
    return v_uv, v_conic, v_opacity


def absolute_uv_vjp(
    dx: Float[Tensor, "K P"],
    dy: Float[Tensor, "K P"],
    conic: Float[Tensor, "K 3"],
    alpha: Float[Tensor, "K P"],
    v_alpha: Float[Tensor, "K P"],
) -> Float[Tensor, "K 2"]:
    """As ``v_uv`` of ``splat_alpha_vjp``, but the sum of the absolute values of the pixels' dL/du
    and dL/dv."""
    g = v_alpha * alpha
    A, B, C = conic[:, :, None].unbind(1)
    v_uv_p = torch.stack(
        [g * (A * dx + B * dy), g * (B * dx + C * dy)],
        dim=1,
    )
    return v_uv_p.abs().sum(2)


@piece
def blend(
    alpha: Float[Tensor, "K P"], c: Float[Tensor, "K 5"]
) -> tuple[Float[Tensor, "K P"], Float[Tensor, "P 5"]]:
    """Weights of K sorted Gaussians at P pixels, and the blended values C of the pixels."""
    _, w = blend_weights(alpha)
    return w, w.T @ c  # C = sum_k c_k alpha_k T_k: Kerbl Eq. 3, RTG-SLAM Eq. 1, GSFusion Eq. 11


@piece
def blend_vjp(
    alpha: Float[Tensor, "K P"],
    c: Float[Tensor, "K 5"],
    v_C: Float[Tensor, "P 5"],
) -> tuple[Float[Tensor, "K P"], Float[Tensor, "K 5"]]:
    """Gradient of ``blend``: v_alpha, zero where alpha is clamped, cut or behind the last blended
    one; and v_c."""
    T, w = blend_weights(alpha)
    # w_k = alpha_k T_k, and every T_j behind has the factor 1 - alpha_k
    c_dot_v = c @ v_C.T
    S = _sum_behind(w * c_dot_v)
    moves = (w > 0) & (alpha < ALPHA_MAX)
    v_alpha_k = torch.where(moves, T * c_dot_v - S / (1 - alpha), 0.0)
    return v_alpha_k, w @ v_C  # C = sum_k w_k c_k


def blend_weights(alpha: Float[Tensor, "K P"]) -> tuple[Float[Tensor, "K P"], Float[Tensor, "K P"]]:
    """T_k and w_k; blending stops before the first Gaussian behind which T would be below 1e-4."""
    T_behind = (1 - alpha).cumprod(dim=0)  # RTG-SLAM Eq. 3
    T = torch.cat([torch.ones_like(alpha[:1]), T_behind[:-1]])
    return T, torch.where(T_behind >= TRANSMITTANCE_MIN, alpha * T, 0.0)


def _sum_behind(value: Float[Tensor, "K P"]) -> Float[Tensor, "K P"]:
    """sum_{j>k} value_j."""
    return value.flip(0).cumsum(0).flip(0) - value


def _nearest(
    mask: Bool[Tensor, "K P"],
    gaussian: Int[Tensor, " K"],
) -> Int[Tensor, " P"]:
    """The first Gaussian of each pixel for which the mask is true, or -1."""
    return torch.where(
        mask.any(dim=0),
        gaussian[mask.int().argmax(dim=0)],
        -1,
    )
