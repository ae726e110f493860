"""The Gaussians of a picture as they were blended: ellipses, colours and the list of each tile."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..types import Camera
from .composite import blend_weights, pixel_offsets, splat_alpha
from .tiles import TileLists


def blend_rows(
    uv: Float[Tensor, "K 2"],
    conic: Float[Tensor, "K 3"],
    opacity: Float[Tensor, " K"],
    x: Int[Tensor, " P"],
    y: Int[Tensor, " P"],
) -> tuple[Float[Tensor, "K P"], Float[Tensor, "K P"], Float[Tensor, "K P"]]:
    """alpha, T and w of K Gaussians, nearest first, at the pixels in columns ``x`` and rows ``y``, by the formulas of
    ``composite``; w is 0 from where a pixel stops. Differentiable: no."""
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

    def blend(self, tile: int, x: Int[Tensor, " P"], y: Int[Tensor, " P"]) -> TileBlend:
        """alpha, T and w of the list of a tile at its pixels in columns ``x`` and rows ``y``, by the formulas of
        ``composite`` from the values that were blended."""
        k = self.tiles.gaussians_of(tile).long()
        if not len(k):
            none = self.uv.new_zeros(0, len(x))
            return TileBlend(gaussian=k, alpha=none, transmittance=none, weight=none)
        alpha, T, w = blend_rows(self.uv[k], self.conic[k], self.opacity[k], x, y)
        return TileBlend(gaussian=k, alpha=alpha, transmittance=T, weight=w)

    def pixels_of(self, tile: int, camera: Camera) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"]]:
        """Columns and rows of the pixels of a tile that are drawn."""
        y, x = self.tiles.pixels_of(tile, camera)
        return x, y

    def tiles_with(self, row: int) -> list[tuple[int, int]]:
        """Tiles in whose lists a Gaussian is, and its place there, 0 for the nearest."""
        at = (self.tiles.gaussian == row).nonzero()[:, 0]
        tile = torch.searchsorted(self.tiles.offset, at.to(self.tiles.offset.dtype), right=True) - 1
        return [(int(t), int(i - self.tiles.offset[t])) for t, i in zip(tile, at, strict=True)]
