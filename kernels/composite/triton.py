"""Front-to-back blending of each tile's list, and its gradient; the formulas are those of ``render.composite``.

A tile of 8 x 8 pixels is one warp, two pixels a thread, which walks the list: its sums over pixels need no shared
memory and no barrier, it stops as soon as its own pixels are dark, and small tiles list few splats that miss most of
them. The gradient walks the list in the same order and makes alpha and T again; what lies behind a splat is the pixel's
total, known from the picture, less what has been passed. Ten sums per (splat, tile), reduced in the warp, are added to
the splat by one 40-byte atomic instruction, and only where the tile sees the splat and it is not frozen.
"""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportIndexIssue=false

import triton
import triton.language as tl

from gsfusion_nb.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

from ..project.triton import BLUE, CONIC_A, CONIC_B, CONIC_C, DEPTH, GREEN, LN_OPACITY, RED, SPLAT, U, V
from ..runtime.triton.vectors import load3, store3

TILE = 8
"""Edge of a tile, pixels."""

STEP = 16
"""Entries between two looks whether the tile is finished."""

_ALPHA_MAX = tl.constexpr(ALPHA_MAX)
_ALPHA_MIN = tl.constexpr(ALPHA_MIN)
_T_MIN = tl.constexpr(TRANSMITTANCE_MIN)


@triton.jit
def _pixels_of(t, width, height, tiles_x, pixels, MASKED: tl.constexpr, TILE: tl.constexpr):
    """Places and centres of a tile's pixels, and which are to be drawn."""
    k = tl.arange(0, TILE * TILE)
    x, y = (t % tiles_x) * TILE + k % TILE, (t // tiles_x) * TILE + k // TILE
    inside = (x < width) & (y < height)
    at = y * width + x
    lit = inside
    if MASKED:
        lit = lit & (tl.load(pixels + at, mask=inside, other=0) != 0)
    return at, x + 0.5, y + 0.5, inside, lit


@triton.jit
def _blend(s, x, y, T):
    """alpha of a splat, its weight, T behind it, and the offsets from its centre. T is 0 where a pixel has stopped."""
    dx, dy = x - tl.load(s + U), y - tl.load(s + V)
    A, B, C = tl.load(s + CONIC_A), tl.load(s + CONIC_B), tl.load(s + CONIC_C)
    sigma = 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy
    alpha = tl.minimum(tl.exp(tl.load(s + LN_OPACITY) - sigma), _ALPHA_MAX)
    alpha = tl.where(alpha > _ALPHA_MIN, alpha, 0.0)
    behind = T * (1.0 - alpha)
    on = behind >= _T_MIN
    return alpha, tl.where(on, alpha * T, 0.0), tl.where(on, behind, 0.0), dx, dy


@triton.jit(do_not_specialize=["width", "height", "tiles_x", "opaque_alpha"])
def composite_forward(
    splats, ids, offset, pixels, rgb, depth, alpha_image, first_image, dominant_image, hit_image,
    width, height, tiles_x, opaque_alpha, MASKED: tl.constexpr, INDICES: tl.constexpr, HITS: tl.constexpr,
    TILE: tl.constexpr, STEP: tl.constexpr,
):  # fmt: skip
    """One tile: colour, depth, alpha; with INDICES the first and the dominant row, with HITS the first opaque row."""
    t = tl.program_id(0)
    at, x, y, inside, lit = _pixels_of(t, width, height, tiles_x, pixels, MASKED, TILE)
    T = lit.to(tl.float32)
    red, green, blue, z, opaque = 0.0 * x, 0.0 * x, 0.0 * x, 0.0 * x, 0.0 * x
    first, dominant = tl.full([TILE * TILE], -1, tl.int32), tl.full([TILE * TILE], -1, tl.int32)
    hit = tl.where(lit, -1, -2)
    heaviest = 0.0 * x
    k, end = tl.load(offset + t), tl.load(offset + t + 1)
    going = k < end
    following = tl.load(ids + k, mask=going, other=0)  # one ahead: its splat can be asked for at once
    while going:
        stop = tl.minimum(k + STEP, end)
        while k < stop:
            g = following
            k += 1
            following = tl.load(ids + k, mask=k < end, other=0)
            s = splats + g * SPLAT
            alpha, w, T, _, _ = _blend(s, x, y, T)
            red += w * tl.load(s + RED)
            green += w * tl.load(s + GREEN)
            blue += w * tl.load(s + BLUE)
            z += w * tl.load(s + DEPTH)
            opaque += w
            if INDICES:
                first = tl.where((w > 0) & (first < 0), g, first)
                dominant = tl.where(w > heaviest, g, dominant)
                heaviest = tl.maximum(w, heaviest)
            if HITS:
                hit = tl.where((alpha >= opaque_alpha) & (hit == -1), g, hit)
        left = tl.max(T, axis=0) > 0
        if HITS:
            left = left | (tl.max((hit == -1).to(tl.int32), axis=0) > 0)
        going = (k < end) & left
    store3(rgb, at, red, green, blue, inside)
    tl.store(depth + at, z, mask=inside)
    tl.store(alpha_image + at, opaque, mask=inside)
    if INDICES:
        tl.store(first_image + at, first.to(tl.int64), mask=inside)
        tl.store(dominant_image + at, dominant.to(tl.int64), mask=inside)
    if HITS:
        tl.store(hit_image + at, tl.maximum(hit, -1).to(tl.int64), mask=inside)


@triton.jit(do_not_specialize=["width", "height", "tiles_x"])
def composite_backward(
    splats, ids, offset, pixels, trained, rgb, depth, alpha_image, v_rgb, v_depth, v_alpha, v_splats,
    width, height, tiles_x, MASKED: tl.constexpr, SOME: tl.constexpr, WITH_DEPTH: tl.constexpr,
    WITH_ALPHA: tl.constexpr, TILE: tl.constexpr, STEP: tl.constexpr,
):  # fmt: skip
    """Add one tile's gradients to ``v_splats``, whose columns are those of the splats, up to the depth."""
    t = tl.program_id(0)
    at, x, y, _, lit = _pixels_of(t, width, height, tiles_x, pixels, MASKED, TILE)
    T = lit.to(tl.float32)
    v_r, v_g, v_b = load3(v_rgb, at, lit)
    red, green, blue = load3(rgb, at, lit)
    S = v_r * red
    S += v_g * green
    S += v_b * blue
    v_z, v_o = 0.0 * x, 0.0 * x
    if WITH_DEPTH:
        v_z = tl.load(v_depth + at, mask=lit, other=0.0)
        S += v_z * tl.load(depth + at, mask=lit, other=0.0)
    if WITH_ALPHA:
        v_o = tl.load(v_alpha + at, mask=lit, other=0.0)
        S += v_o * tl.load(alpha_image + at, mask=lit, other=0.0)
    lane = tl.arange(0, 16)
    k, end = tl.load(offset + t), tl.load(offset + t + 1)
    going = k < end
    following = tl.load(ids + k, mask=going, other=0)  # one ahead: its splat can be asked for at once
    while going:
        stop = tl.minimum(k + STEP, end)
        while k < stop:
            g = following
            k += 1
            following = tl.load(ids + k, mask=k < end, other=0)
            s = splats + g * SPLAT
            alpha, w, T, dx, dy = _blend(s, x, y, T)
            cv = (
                tl.load(s + RED) * v_r
                + tl.load(s + GREEN) * v_g
                + tl.load(s + BLUE) * v_b
                + tl.load(s + DEPTH) * v_z
                + v_o
            )
            w_cv = w * cv
            S -= w_cv
            wanted = tl.max(w, axis=0) > 0
            if SOME:
                wanted = wanted & (tl.load(trained + g) != 0)
            if wanted:
                v = tl.where((w > 0) & (alpha < _ALPHA_MAX), w_cv - S * alpha / (1.0 - alpha), 0.0)  # alpha dL/dalpha
                v_x, v_y = v * dx, v * dy
                sum_x, sum_y = tl.sum(v_x, axis=0), tl.sum(v_y, axis=0)
                A, B, C = tl.load(s + CONIC_A), tl.load(s + CONIC_B), tl.load(s + CONIC_C)
                out = tl.where(lane == U, A * sum_x + B * sum_y, B * sum_x + C * sum_y)
                out = tl.where(lane == CONIC_A, -0.5 * tl.sum(v_x * dx, axis=0), out)
                out = tl.where(lane == CONIC_B, -tl.sum(v_x * dy, axis=0), out)
                out = tl.where(lane == CONIC_C, -0.5 * tl.sum(v_y * dy, axis=0), out)
                out = tl.where(lane == LN_OPACITY, tl.sum(v, axis=0), out)
                out = tl.where(lane == RED, tl.sum(w * v_r, axis=0), out)
                out = tl.where(lane == GREEN, tl.sum(w * v_g, axis=0), out)
                out = tl.where(lane == BLUE, tl.sum(w * v_b, axis=0), out)
                if WITH_DEPTH:
                    out = tl.where(lane == DEPTH, tl.sum(w * v_z, axis=0), out)
                    tl.atomic_add(v_splats + g * SPLAT + lane, out, mask=lane <= DEPTH, sem="relaxed")
                else:
                    tl.atomic_add(v_splats + g * SPLAT + lane, out, mask=lane < DEPTH, sem="relaxed")
        going = (k < end) & (tl.max(T, axis=0) > 0)
