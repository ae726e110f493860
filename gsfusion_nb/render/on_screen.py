"""Which Gaussians a camera sees, how large they are in its picture, and how they were blended
there."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import op
from ..checks import check_positive
from ..geometry import se3
from ..geometry.operands import check_gaussians, check_view
from ..types import Camera, GaussianParams
from .composite import blend_weights, pixel_offsets, splat_alpha
from .constants import ALPHA_MIN, FRUSTUM_CLAMP, NEAR_PLANE_M, SCREEN_BLUR_PX2
from .near_plane import near_plane_option
from .project import project_gaussians
from .tiles import TileLists


def blend_rows(
    uv: Float[Tensor, "K 2"],
    conic: Float[Tensor, "K 3"],
    opacity: Float[Tensor, " K"],
    x: Int[Tensor, " P"],
    y: Int[Tensor, " P"],
) -> tuple[Float[Tensor, "K P"], Float[Tensor, "K P"], Float[Tensor, "K P"]]:
    """alpha, T and w of K Gaussians, nearest first, at the pixels in columns ``x`` and rows ``y``,
    by the formulas of ``composite``; w is 0 from where a pixel stops. Differentiable: no."""
    alpha = splat_alpha(*pixel_offsets(uv, x, y), conic, opacity)
    return alpha, *blend_weights(alpha)


@dataclass(frozen=True, kw_only=True, eq=False)
class TileBlend:
    """The list of one tile at some of its pixels: K Gaussians, nearest first, at P pixels."""

    gaussian: Int[Tensor, " K"]
    """Row of each in what was rendered."""
    alpha: Float[Tensor, "K P"]
    transmittance: Float[Tensor, "K P"]
    """T_k, the light left in front of each."""
    weight: Float[Tensor, "K P"]
    """w_k = alpha_k T_k, 0 from where the pixel stops."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ScreenGaussians:
    """What one rendering blended. Rows that are in no list contain numbers without meaning."""

    uv: Float[Tensor, "N 2"]
    """Centre, pixels."""
    conic: Float[Tensor, "N 3"]
    """A, B, C of sigma = (A dx^2 + C dy^2) / 2 + B dx dy, 1/px^2."""
    opacity: Float[Tensor, " N"]
    rgb: Float[Tensor, "N 3"]
    """Colour seen from the camera."""
    depth_m: Float[Tensor, " N"]
    """z of the centre in the camera frame, metres."""
    tiles: TileLists

    def tile_of(self, u: int, v: int) -> int:
        """Number of the tile that holds the pixel in column ``u`` and row ``v``."""
        return v // self.tiles.tile_px * self.tiles.tiles_x + u // self.tiles.tile_px

    def blend(
        self,
        tile: int,
        x: Int[Tensor, " P"],
        y: Int[Tensor, " P"],
    ) -> TileBlend:
        """alpha, T and w of the list of a tile at its pixels in columns ``x`` and rows ``y``, by
        the formulas of ``composite`` from the values that were blended."""
        k = self.tiles.gaussians_of(tile).long()
        if not len(k):
            none = self.uv.new_zeros(0, len(x))
            return TileBlend(gaussian=k, alpha=none, transmittance=none, weight=none)
        alpha, T, w = blend_rows(
            self.uv[k],
            self.conic[k],
            self.opacity[k],
            x,
            y,
        )
        return TileBlend(gaussian=k, alpha=alpha, transmittance=T, weight=w)

    def pixels_of(
        self,
        tile: int,
        camera: Camera,
    ) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"]]:
        """Columns and rows of the pixels of a tile that are drawn."""
        y, x = self.tiles.pixels_of(tile, camera)
        return x, y

    def tiles_with(self, row: int) -> list[tuple[int, int]]:
        """Tiles in whose lists a Gaussian is, and its place there, 0 for the nearest."""
        at = (self.tiles.gaussian == row).nonzero()[:, 0]
        tile = (
            torch.searchsorted(
                self.tiles.offset,
                at.to(self.tiles.offset.dtype),
                right=True,
            )
            - 1
        )
        return [(int(t), int(i - self.tiles.offset[t])) for t, i in zip(tile, at, strict=True)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Footprints:
    """Every Gaussian as a camera sees it, whether something hides it or not."""

    visible: Bool[Tensor, " N"]
    """Whether the box outside which its alpha is below 1/255 reaches into the image."""
    radius_px: Float[Tensor, " N"]
    """Half of the longer side of that box, pixels; 0 where not visible."""


def check_footprints(params: Any, camera: Any, T_WC: Any, near_m: Any = NEAR_PLANE_M) -> None:
    """Raise ``ValueError`` for arguments that ``footprints`` refuses."""
    check_gaussians(params)
    check_view(camera, T_WC, params.xyz_W.device)
    check_positive("near_m", near_m)


@op("footprints", check_footprints)
@torch.no_grad()
def footprints(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    near_m: float = NEAR_PLANE_M,
) -> Footprints:
    """Visibility and size in the image of every Gaussian.

    Args:
        params, camera, T_WC, near_m: as given to ``render``.

    Differentiable: no.
    Source: Kerbl et al. 2023, section 6; the size of the box is that of ``project_gaussians``,
    which depends on the opacity.
    """
    rows = rows_in_view(params, camera, T_WC, near_m).nonzero()[:, 0]
    p = project_gaussians(params[rows], camera, T_WC, **near_plane_option(near_m))
    image_size = p.uv.new_tensor([camera.width, camera.height])
    in_image = ((p.uv + p.extent_px > 0) & (p.uv - p.extent_px < image_size)).all(1)
    visible = p.visible & in_image & params.sh[rows].isfinite().all(2).all(1)
    every = torch.zeros(len(params), dtype=torch.bool, device=rows.device)
    radius_px = p.extent_px.new_zeros(len(params))
    every[rows] = visible
    radius_px[rows] = torch.where(visible, p.extent_px.amax(1), 0.0)
    return Footprints(visible=every, radius_px=radius_px)


@torch.no_grad()
def rows_in_view(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    near_m: float = NEAR_PLANE_M,
) -> Bool[Tensor, " N"]:
    """Rows that may reach a pixel of the picture; the others change nothing in it and get no
    gradient from it.

    It bounds the box that ``project_gaussians`` computes: with s the largest standard deviation and
    |tx| <= c, where c is 1.3 half fields of view,

        cov_uu = |first row of J W R S|^2 + 0.3 <= (fx s / z)^2 (1 + c^2) + 0.3

    Args:
        params, camera, T_WC, near_m: as given to ``render``.

    Returns:
        True for every row that is drawn, and for a few others. [N]
    """
    x, y, z = se3.apply(se3.inverse(T_WC.to(params.xyz_W)), params.xyz_W).unbind(-1)
    opacity = params.opacity_logit.sigmoid()
    reach = 2 * (opacity / ALPHA_MIN).clamp_min(1.0).log()
    spread = (params.log_scale.amax(dim=1).exp() / z).square()

    def meets(along: Tensor, focal: float, centre: float, size: int) -> Tensor:
        """Whether the box reaches into the image, 0 to ``size`` pixels along one axis."""
        c = FRUSTUM_CLAMP * size / (2 * focal)
        variance = focal**2 * (1 + c**2) * spread + SCREEN_BLUR_PX2
        extent = (reach * variance).sqrt() * (1 + 1e-4)  # a little more, for rounding
        return (focal * along / z + centre - size / 2).abs() <= size / 2 + extent

    in_picture = meets(x, camera.fx, camera.cx, camera.width) & meets(
        y, camera.fy, camera.cy, camera.height
    )
    return in_picture & (z > near_m) & (opacity >= ALPHA_MIN)
