"""gsplat's torch implementation, for comparison on the CPU.

gsplat 1.5 ships its rasteriser in torch, but two parts exist for CUDA only: ``rasterize_to_indices_in_range`` (which
Gaussian counts at which pixel) and nerfacc's scans over packed rays. Both are written here for the CPU and inserted
into gsplat while it runs; projection, spherical harmonics, tile lists and blending are gsplat's own.
"""

import contextlib
import sys
import types
from collections.abc import Iterator
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from ...constants import ALPHA_MIN, NEAR_PLANE_M, TRANSMITTANCE_MIN
from ...geometry import se3
from ...types import GaussianParams
from .scene import RandomScene

_TILE = 16
_ALPHA_MAX = 0.999
"""The same limit as in gsplat."""

BYTES_PER_PIXEL = 6000
"""Memory of a forward and backward pass on a scene with 30 Gaussians per pixel, bytes: 1.7 GB at 640x480."""


def render(params: GaussianParams, scene: RandomScene) -> Tensor:
    """The picture. [H, W, 3] Differentiable: yes, by autograd."""
    from gsplat.cuda import _torch_impl as gsplat  # pyright: ignore[reportMissingImports]

    camera = scene.camera
    T_CW = se3.inverse(scene.T_WC)[None]
    covariance, _ = gsplat._quat_scale_to_covar_preci(params.quat, params.log_scale.exp(), compute_preci=False)
    K = camera.K.float()[None]
    radii, uv, depth, conic, _ = gsplat._fully_fused_projection(
        params.xyz_W, covariance, T_CW, K, camera.width, camera.height, near_plane=NEAR_PLANE_M
    )
    directions = params.xyz_W - scene.T_WC[:3, 3]
    rgb = (gsplat._spherical_harmonics(params.sh_degree, directions, params.sh) + 0.5).clamp_min(0)[None]
    opacity = params.opacity_logit.sigmoid()[None]
    nx, ny = -(-camera.width // _TILE), -(-camera.height // _TILE)
    _, keys, ids = gsplat._isect_tiles(uv, radii, depth, _TILE, nx, ny)
    offsets = gsplat._isect_offset_encode(keys, 1, nx, ny)
    with _lent():
        picture, _ = gsplat._rasterize_to_pixels(
            uv, conic, rgb, opacity, camera.width, camera.height, _TILE, offsets, ids
        )
    return picture[0]


@contextlib.contextmanager
def _lent() -> Iterator[None]:
    """Insert the two missing parts into gsplat inside the block."""
    from gsplat.cuda import _wrapper  # pyright: ignore[reportMissingImports]

    scans: Any = types.ModuleType("nerfacc")
    scans.render_weight_from_alpha = _weights
    scans.accumulate_along_rays = _sums
    with (
        mock.patch.object(_wrapper, "rasterize_to_indices_in_range", _pairs),
        mock.patch.dict(sys.modules, {"nerfacc": scans}),
    ):
        yield


@torch.no_grad()
def _pairs(first, last, transmittance, uv, conic, opacity, width, height, tile_px, offsets, ids):
    """(Gaussian, pixel, image) of all blended pairs, pixel by pixel, from near to far."""
    nx, ny = offsets.shape[-1], offsets.shape[-2]
    bounds = [*offsets.reshape(-1).tolist(), len(ids)]
    gaussians, pixels = [], []
    for tile in range(nx * ny):
        start = bounds[tile] + first * tile_px**2
        rows = ids[start : min(bounds[tile + 1], bounds[tile] + last * tile_px**2)].long()
        if not len(rows):
            continue
        x0, y0 = tile % nx * tile_px, tile // nx * tile_px
        y, x = torch.meshgrid(
            torch.arange(y0, min(y0 + tile_px, height)), torch.arange(x0, min(x0 + tile_px, width)), indexing="ij"
        )
        pixel = (y * width + x).reshape(-1)
        dx, dy = ((p.reshape(-1, 1) + 0.5 - uv[0, rows, i]) for i, p in enumerate((x, y)))
        A, B, C = conic[0, rows].unbind(-1)
        sigma = 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy
        alpha = (opacity[0, rows] * torch.exp(-sigma)).clamp_max(_ALPHA_MAX)
        alpha = alpha.where((sigma >= 0) & (alpha >= ALPHA_MIN), 0.0)
        left = transmittance[0].reshape(-1)[pixel, None] * (1 - alpha).cumprod(1)
        p, k = ((alpha > 0) & (left > TRANSMITTANCE_MIN)).nonzero(as_tuple=True)
        gaussians.append(rows[k])
        pixels.append(pixel[p])
    none = [torch.zeros(0, dtype=torch.int64)]
    gaussian, pixel = torch.cat(gaussians or none), torch.cat(pixels or none)
    return gaussian, pixel, torch.zeros_like(gaussian)


def _weights(alphas: Tensor, *, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """alpha_k T_k and T_k, T_k the product of 1 - alpha over the earlier entries of the ray, as a sum of logarithms."""
    logs = torch.log1p(-alphas.double())
    before = logs.cumsum(0) - logs
    counts = torch.unique_consecutive(ray_indices, return_counts=True)[1]
    first = counts.cumsum(0) - counts
    T = (before - before[first].repeat_interleave(counts)).exp().to(alphas.dtype)
    return alphas * T, T


def _sums(weights: Tensor, values: Tensor | None, *, ray_indices: Tensor, n_rays: int) -> Tensor:
    """Sum of weight times value over each ray."""
    terms = weights[:, None] if values is None else weights[:, None] * values
    return terms.new_zeros(n_rays, terms.shape[1]).index_add(0, ray_indices, terms)
