"""What a camera sees of a map of discs: colour, transmittance, depth and normals."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..config import DiscConfig
from ..types import Camera, GaussianParams, RenderOutput
from .constants import NEAR_PLANE_M
from .disc import PUBLISHED_DISCS, disc_depth
from .rasterize import render_forward

BLENDED_MIN_ALPHA = 0.5
"""Blended depth is used only where the accumulated alpha is at least this."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceView:
    """Colour, transmittance and surface of the map from one camera (the maps of Peng et al. 2024,
    section 3.1)."""

    rgb: Float[Tensor, "H W 3"]
    transmittance: Float[Tensor, "H W"]
    """Share of the light that passes all Gaussians (Eq. 3)."""
    depth_m: Float[Tensor, "H W"]
    """z-depth of the surface (Eq. 5); 0 where there is none (-1 in the paper)."""
    normal_W: Float[Tensor, "H W 3"]
    """Normal of the hit disc towards the camera, world frame; 0 where none is hit."""
    hit_index: Int[Tensor, "H W"]
    """Row of the hit disc, or -1."""
    dominant_index: Int[Tensor, "H W"]
    """Row of the Gaussian with the largest weight in the colour, or -1."""


def view_surface(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    config: DiscConfig | None = None,
    *,
    pixels: Bool[Tensor, "H W"] | None = None,
    near_m: float = NEAR_PLANE_M,
) -> SurfaceView:
    """Everything that a mapper or tracker needs from the map at one pose, in one pass.

    Args:
        params, camera, T_WC: as for ``render``.
        config: When a disc counts as hit, as published by default; with ``depth="blended"`` the
            depth is sum of w_k z_k / alpha instead.
        pixels: Draw only where this is true. [H, W]
        near_m: Nearer Gaussians are not drawn, metres.

    Differentiable: no; ``render_forward``, ``disc_depth`` and their vjp are.
    """
    config = config or PUBLISHED_DISCS
    options = {} if pixels is None else {"pixels": pixels}
    output, _ = render_forward(
        params, camera, T_WC, opaque_alpha=config.opaque_alpha, near_m=near_m, **options
    )
    hit_index = output.hit_index
    dominant = output.dominant_index
    assert hit_index is not None
    assert dominant is not None
    disc = disc_depth(
        params, camera, T_WC, hit_index, max_offset=config.max_offset, min_cosine=config.min_cosine
    )
    depth_m = disc.depth_m if config.depth == "disc" else blended_depth_m(output)
    return SurfaceView(
        rgb=output.rgb,
        transmittance=1.0 - output.alpha,
        depth_m=depth_m,
        normal_W=disc.normal_W,
        hit_index=hit_index,
        dominant_index=dominant,
    )


def surface_depth_m(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    output: RenderOutput,
    config: DiscConfig,
) -> Float[Tensor, "H W"]:
    """Depth of the surface in ``output`` (rendered with ``opaque_alpha``), metres: of the discs
    hit, or blended."""
    if config.depth == "blended":
        return blended_depth_m(output)
    assert output.hit_index is not None
    return disc_depth(
        params,
        camera,
        T_WC,
        output.hit_index,
        max_offset=config.max_offset,
        min_cosine=config.min_cosine,
    ).depth_m


def blended_depth_m(
    output: RenderOutput, min_alpha: float = BLENDED_MIN_ALPHA
) -> Float[Tensor, "H W"]:
    """sum of w_k z_k / alpha, metres; 0 where alpha is below ``min_alpha``."""
    depth_m = output.depth_m / output.alpha.clamp_min(1e-6)
    return torch.where(output.alpha >= min_alpha, depth_m, 0.0)
