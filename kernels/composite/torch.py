"""Blending and its gradient in whole-array torch code, for any device and float64. Formulas: ``render.composite``.

Arrays are [K, n, P]: K entries along the list, n tiles, P pixels of a tile (``chunks``). Sigma, sums over Gaussians and
sums over pixels are matrix products (``entries``). The gradient goes through the same chunks backwards and computes
alpha and T again instead of keeping them.
"""

from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from gsfusion_nb.backends import Record
from gsfusion_nb.render.composite import CompositeGradient, CompositeOutput
from gsfusion_nb.render.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from gsfusion_nb.render.tiles import TileLists
from gsfusion_nb.types import Camera

from .entries import (
    CONIC,
    NO_HIT,
    OPACITY,
    UV,
    Chunk,
    Entries,
    Scratch,
    centre_slopes,
    cut_into_chunks,
    entries_vjp,
    image_to_tiles,
    list_entries,
    pixel_functions,
    tiles_to_image,
)

_RGB, _DEPTH, _ALPHA = slice(0, 3), 3, 4
_CHANNELS = 5
"""Channels of a Gaussian, and of the picture: colour, depth, and 1, whose sum is the picture's alpha."""

_NOT_DRAWN = -2
"""In place of a row: the pixel is none of the picture's, or not wanted, and looks for no hit."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TorchSaved(Record):
    """What ``composite_vjp`` needs of the forward pass."""

    backend = "torch"
    camera: Camera
    tiles: TileLists
    entries: Entries
    opacity: Float[Tensor, " N"]
    channels: Float[Tensor, "N 5"]
    """r, g, b, z, 1 of each Gaussian."""
    chunks: list[Chunk]
    """In the order they were blended."""


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
    """See ``gsfusion_nb.render.composite``."""
    entries = list_entries(tiles, uv, conic, opacity)
    channels = torch.cat([rgb, depth_m[:, None], torch.ones_like(depth_m)[:, None]], dim=1)
    saved = TorchSaved(camera=camera, tiles=tiles, entries=entries, opacity=opacity, channels=channels, chunks=[])
    functions, scratch = pixel_functions(tiles, uv), Scratch(uv)
    count, P = tiles.tiles_x * tiles.tiles_y, tiles.tile_px**2
    T = image_to_tiles(_light(tiles, camera, uv), tiles).squeeze(1)  # 0 beyond the border
    C = uv.new_zeros(count, _CHANNELS * P)
    ranks = PixelRanks(uv.new_zeros(3, count, P)) if with_indices else None
    hit = None if opaque_alpha is None else torch.where(T > 0, NO_HIT, _NOT_DRAWN)
    for chunk in cut_into_chunks(tiles, T, hit):
        alpha = _alpha(chunk, entries, functions, scratch)
        if hit is not None and opaque_alpha is not None:
            _find_hits(hit, chunk, entries, alpha >= opaque_alpha)
        T_k = _transmittance(alpha, chunk, scratch)
        w = torch.mul(alpha, T_k[:-1], out=scratch("w", *alpha.shape))
        c = _channels_of(chunk, saved)
        C.index_add_(0, chunk.tile, torch.bmm(c.permute(1, 2, 0), w.permute(1, 0, 2)).flatten(1))  # C += sum_k w_k c_k
        T.index_copy_(0, chunk.tile, T_k[-1])
        if ranks is not None:
            ranks.update(chunk, w, T_k, alpha)
        saved.chunks.append(chunk)

    C = C.view(count, _CHANNELS, P)
    image = tiles_to_image(C, tiles, camera)
    first = dominant = None
    if ranks is not None:
        first, dominant = (
            tiles_to_image(ranks.rows(tiles, C[:, _ALPHA] > 0), tiles, camera).permute(2, 0, 1).contiguous()
        )
    return CompositeOutput(
        rgb=image[..., _RGB].contiguous(),
        depth_m=image[..., _DEPTH].contiguous(),
        alpha=image[..., _ALPHA].contiguous(),
        first_index=first,
        dominant_index=dominant,
        hit_index=None if hit is None else tiles_to_image(hit[:, None], tiles, camera).squeeze(-1).clamp(min=NO_HIT),
        saved=saved,
    )


def composite_vjp(
    saved: TorchSaved,
    v_rgb: Float[Tensor, "H W 3"],
    v_depth_m: Float[Tensor, "H W"] | None = None,
    v_alpha: Float[Tensor, "H W"] | None = None,
    *,
    with_uv_abs: bool = False,
) -> CompositeGradient:
    """See ``gsfusion_nb.render.composite_vjp``."""
    tiles, entries, P = saved.tiles, saved.entries, saved.tiles.tile_px**2
    v_depth_m, v_alpha = (torch.zeros_like(v_rgb[..., 0]) if v is None else v for v in (v_depth_m, v_alpha))
    v_image = torch.cat([v_rgb, v_depth_m[..., None], v_alpha[..., None]], dim=-1)
    if tiles.pixels is not None:
        v_image = torch.where(tiles.pixels[..., None], v_image, 0.0)
    v_C = image_to_tiles(v_image, tiles).flatten(1)
    functions, scratch = pixel_functions(tiles, v_C), Scratch(v_C)
    some_clamped = bool((saved.opacity > ALPHA_MAX).any())
    S_behind = v_C.new_zeros(len(v_C), P)
    v_poly, v_channels = torch.zeros_like(entries.poly), torch.zeros_like(saved.channels)
    v_uv_abs = v_C.new_zeros(len(saved.opacity), 2) if with_uv_abs else None
    for chunk in reversed(saved.chunks):
        K, n = chunk.entry.shape
        alpha = _alpha(chunk, entries, functions, scratch)
        T_k = _transmittance(alpha, chunk, scratch)
        w = torch.mul(alpha, T_k[:-1], out=scratch("w", K, n, P))
        v = v_C.index_select(0, chunk.tile).view(n, _CHANNELS, P)
        v_c = torch.bmm(v, w.permute(1, 2, 0))  # dL/dc_k = w_k v_C, summed over the pixels
        v_channels.index_add_(0, _rows_of(chunk, entries), v_c.permute(2, 0, 1).reshape(-1, _CHANNELS))

        cv = torch.bmm(_channels_of(chunk, saved).permute(1, 0, 2), v, out=scratch("cv", n, K, P)).permute(1, 0, 2)
        w_cv = torch.mul(w, cv, out=scratch("w_cv", K, n, P))  # w_k (c_k . v_C)
        S = _behind(w_cv, S_behind.index_select(0, chunk.tile), scratch("S", K, n, P))
        S_behind.index_copy_(0, chunk.tile, S[0] + w_cv[0])
        # alpha dL/dalpha = w (c . v_C) - S alpha / (1 - alpha),  and alpha_k / (1 - alpha_k) = w_k / T_{k+1}
        v_ln_alpha = w_cv.addcmul_(w.div_(T_k[1:]), S, value=-1)
        if some_clamped:
            v_ln_alpha.masked_fill_(alpha >= ALPHA_MAX, 0.0)
        v_poly.index_copy_(0, chunk.entry.flatten(), v_ln_alpha.view(-1, P) @ functions.T)
        if v_uv_abs is not None:
            _add_absolute(v_uv_abs, chunk, entries, v_ln_alpha.view(-1, P), functions)

    v_ellipse = entries_vjp(entries, v_poly, saved.opacity)
    return CompositeGradient(
        uv=v_ellipse[:, UV],
        conic=v_ellipse[:, CONIC],
        opacity=v_ellipse[:, OPACITY],
        rgb=v_channels[:, _RGB],
        depth_m=v_channels[:, _DEPTH],
        uv_abs=v_uv_abs,
    )


def _light(tiles: TileLists, camera: Camera, like: Tensor) -> Tensor:
    """1 at the pixels to be drawn, 0 at the others. [H, W, 1]"""
    if tiles.pixels is None:
        return like.new_ones(camera.height, camera.width, 1)
    return tiles.pixels[..., None].to(like)


def _alpha(chunk: Chunk, entries: Entries, functions: Tensor, scratch: Scratch) -> Tensor:
    """alpha_k [K, n, P] of a chunk, whether the pixel has stopped or not."""
    K, n, P = *chunk.entry.shape, functions.shape[1]
    alpha = scratch("alpha", K, n, P)
    torch.mm(entries.poly.index_select(0, chunk.entry.flatten()), functions, out=alpha.view(-1, P))  # ln o - sigma
    alpha.clamp_min_(-20.0).exp_().clamp_max_(ALPHA_MAX)  # exp is slow where it underflows, and e^-20 is cut as well
    return torch.threshold_(alpha, ALPHA_MIN, 0.0)


def _transmittance(alpha: Tensor, chunk: Chunk, scratch: Scratch) -> Tensor:
    """T_k [K + 1, n, P] of a chunk; ``alpha`` becomes zero where the pixel has stopped."""
    K, n, P = alpha.shape
    T = scratch("T", K + 1, n, P)
    T[0] = chunk.T
    torch.sub(1.0, alpha, out=T[1:])
    for T_k, T_next in pairwise(T.unbind(0)):
        T_next.mul_(T_k)  # T_{k+1} = T_k (1 - alpha_k)
    if T[-1].min() < TRANSMITTANCE_MIN:
        # T never rises, so T_{k+1} < 1e-4 means that the pixel stopped at k or before
        alpha.mul_(torch.ge(T[1:], TRANSMITTANCE_MIN, out=scratch("w", K, n, P)))
        T.clamp_min_(0.5 * TRANSMITTANCE_MIN)  # still stopped, and the gradient divides by it
    return T


def _behind(w_cv: Tensor, S_last: Tensor, S: Tensor) -> Tensor:
    """S_k = sum_{j>k} w_j (c_j . v_C), written to ``S``, given the sum behind the chunk."""
    S[-1] = S_last
    S_k, w_cv_k = S.unbind(0), w_cv.unbind(0)
    for k in range(len(S) - 1, 0, -1):
        torch.add(S_k[k], w_cv_k[k], out=S_k[k - 1])
    return S


def _add_absolute(v_uv_abs: Tensor, chunk: Chunk, entries: Entries, v_ln_alpha: Tensor, functions: Tensor) -> None:
    """Add sum_pixels |dL/d(ln alpha) d(ln alpha)/d(u, v)| of a chunk to its Gaussians. v_ln_alpha: [K n, P]"""
    slopes = centre_slopes(entries, chunk.entry.flatten(), functions)
    v_entry = torch.stack([slope.mul_(v_ln_alpha).abs_().sum(1) for slope in slopes], dim=1)
    v_uv_abs.index_add_(0, _rows_of(chunk, entries), v_entry)


def _rows_of(chunk: Chunk, entries: Entries) -> Tensor:
    return entries.row.index_select(0, chunk.entry.flatten())


def _channels_of(chunk: Chunk, saved: TorchSaved) -> Tensor:
    """c_k of a chunk. [K, n, 5]"""
    return saved.channels.index_select(0, _rows_of(chunk, saved.entries)).view(*chunk.entry.shape, _CHANNELS)


def _find_hits(hit: Tensor, chunk: Chunk, entries: Entries, opaque: Tensor) -> None:
    """Write to ``hit`` [tiles, P] the rows of the first opaque Gaussians of pixels that had none before the chunk."""
    rows = _rows_of(chunk, entries).view(chunk.entry.shape)
    k = opaque.to(torch.uint8).argmax(0)  # of equals the first
    before = hit.index_select(0, chunk.tile)
    found = (before == NO_HIT) & opaque.any(0)
    hit.index_copy_(0, chunk.tile, torch.where(found, rows.T.gather(1, k), before))


class PixelRanks:
    """Where in its tile's list each pixel's first and heaviest Gaussian stand, kept up to date chunk by chunk."""

    def __init__(self, zeros: Float[Tensor, "3 tiles P"]):
        self.first, self.dominant, self.heaviest = zeros

    def update(self, chunk: Chunk, w: Tensor, T_k: Tensor, scratch: Tensor) -> None:
        """Look at one more chunk. ``w`` and ``scratch`` are overwritten."""
        tile, K = chunk.tile, len(w)
        untouched = torch.floor(T_k[1:], out=scratch).sum(0)  # T is 1 until the first hit and below 1 from there on
        self.first.index_add_(0, tile, untouched)
        best = w.amax(0)
        countdown = torch.arange(K, 0, -1, device=w.device, dtype=w.dtype)[:, None, None]
        rank = chunk.first_rank + K - w.eq_(best).mul_(countdown).amax(0)  # of equals the nearest
        before = self.heaviest.index_select(0, tile)
        self.dominant.index_copy_(0, tile, torch.where(best > before, rank, self.dominant.index_select(0, tile)))
        self.heaviest.index_copy_(0, tile, torch.maximum(best, before))

    def rows(self, tiles: TileLists, hit: Tensor) -> Tensor:
        """Rows of the first and the heaviest Gaussian, -1 where there is none. [tiles, 2, P]"""
        row = torch.cat([tiles.gaussian, tiles.gaussian.new_zeros(1)])
        place = torch.stack([self.first, self.dominant], dim=1).long() + tiles.offset[:-1, None, None]
        rows = row.index_select(0, place.flatten().clamp_max(len(row) - 1)).view(place.shape)
        return torch.where(hit[:, None], rows, -1)
