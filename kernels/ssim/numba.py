"""D-SSIM and its gradient: every window average is a row pass and a column pass over rows of
interleaved colour.

A row is its 3 W values, so neighbours of one channel are 3 apart; rows are padded to whole vectors.
The formulas are those of ``gsfusion_nb.optim.structural``.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.optim import structural as reference

from ..runtime.numba.launch import launching, scratch
from ..runtime.numba.simd import LANES, iota, load, reduce_add, select, splat, store
from .window import BY_MEAN, BY_PRODUCT, BY_SQUARE, N_MEANS, N_TERMS, XX, XY, YY, X, Y
from .window import window as window_weights

f32 = np.float32
_HALF = reference.WINDOW_PX // 2
_REACH = 3 * _HALF
_C1 = f32(reference.C1)
_C2 = f32(reference.C2)
_1 = f32(1)
_2 = f32(2)


def dssim_vjp(
    rgb: Tensor,
    target: Tensor,
    v_loss: float = 1.0,
) -> tuple[Tensor, Tensor]:
    """See ``gsfusion_nb.optim.dssim_vjp``."""
    if rgb.dtype != torch.float32 or target.dtype != torch.float32:
        return reference.dssim_vjp.reference(rgb, target, v_loss)
    H, W = rgb.shape[:2]
    stride = -(-3 * W // LANES) * LANES
    x, y = (image.detach().contiguous().numpy().reshape(H, 3 * W) for image in (rgb, target))
    window = window_weights(torch.device("cpu")).numpy()
    similarity = np.empty(H, np.float64)
    gradient = torch.empty(H, W, 3)
    with launching():
        means = scratch("ssim_means", N_MEANS * H * stride).reshape(N_MEANS, -1)
        terms = scratch("ssim_terms", N_TERMS * H * stride).reshape(N_TERMS, -1)
        _average_rows(x, y, window, stride, means)
        _differentiate(means, window, 3 * W, stride, terms, similarity)
        _average_rows_again(terms, window, 3 * W, stride, means)
        scale = f32(-v_loss / rgb.numel())
        _combine(means, x, y, window, stride, scale, gradient.numpy().reshape(H, 3 * W))
    loss = torch.tensor(1.0 - similarity.sum() / rgb.numel(), dtype=torch.float32)
    return loss, gradient


@njit(cache=True, error_model="numpy")
def _average_row(row, window, stride, means, start):
    """Weighted mean along a row that is padded by the window's reach on both sides."""
    for j in range(0, stride, LANES):
        total = splat(window[0]) * load(row, j)
        for k in range(1, window.shape[0]):
            total = total + splat(window[k]) * load(row, j + 3 * k)
        store(means, start + j, total)


@njit(parallel=True, cache=True, error_model="numpy")
def _average_rows(x, y, window, stride, means):
    """Row averages of x, y, x^2, y^2 and x y."""
    H, n = x.shape
    for r in prange(H):
        row = np.zeros(stride + 2 * _REACH + LANES, np.float32)
        for plane in range(N_MEANS):
            for i in range(n):
                a = x[r, i]
                b = y[r, i]
                square = a * a if plane == XX else b * b if plane == YY else a * b
                row[_REACH + i] = a if plane == X else b if plane == Y else square
            _average_row(row, window, stride, means[plane], r * stride)


@njit(inline="always")
def _average_column(plane, window, r, H, stride, j):
    total = splat(f32(0))
    for k in range(max(0, _HALF - r), min(2 * _HALF + 1, H + _HALF - r)):
        total = total + splat(window[k]) * load(plane, (r + k - _HALF) * stride + j)
    return total


@njit(parallel=True, cache=True, error_model="numpy")
def _differentiate(means, window, n, stride, terms, similarity):
    """SSIM of every value, summed per row, and its derivatives by mu_x, G x^2 and G x y."""
    H = similarity.shape[0]
    for r in prange(H):
        c1 = splat(_C1)
        c2 = splat(_C2)
        two = splat(_2)
        zero = splat(f32(0))
        total = 0.0
        for j in range(0, stride, LANES):
            mx = _average_column(means[X], window, r, H, stride, j)
            my = _average_column(means[Y], window, r, H, stride, j)
            xx = _average_column(means[XX], window, r, H, stride, j)
            yy = _average_column(means[YY], window, r, H, stride, j)
            xy = _average_column(means[XY], window, r, H, stride, j)
            A1 = two * mx * my + c1
            A2 = two * (xy - mx * my) + c2
            B1 = mx * mx + my * my + c1
            B2 = (xx - mx * mx) + (yy - my * my) + c2
            inverse_1 = splat(_1) / B1
            inverse_2 = splat(_1) / B2
            both = inverse_1 * inverse_2
            in_row = (splat(f32(j)) + iota()) < splat(f32(n))
            S = select(in_row, A1 * A2 * both, zero)
            total += reduce_add(S)
            o = r * stride + j
            store(
                terms[BY_MEAN],
                o,
                two * my * (A2 - A1) * both + two * mx * S * (inverse_2 - inverse_1),
            )
            store(terms[BY_SQUARE], o, zero - S * inverse_2)
            store(terms[BY_PRODUCT], o, select(in_row, two * A1 * both, zero))
        similarity[r] = total


@njit(parallel=True, cache=True, error_model="numpy")
def _average_rows_again(terms, window, n, stride, means):
    """Row averages of the three derivatives."""
    for r in prange(terms.shape[1] // stride):
        row = np.zeros(stride + 2 * _REACH + LANES, np.float32)
        for term in range(N_TERMS):
            row[_REACH : _REACH + n] = terms[term, r * stride : r * stride + n]
            _average_row(row, window, stride, means[term], r * stride)


@njit(parallel=True, cache=True, error_model="numpy")
def _combine(means, x, y, window, stride, scale, gradient):
    """v_x = scale (G v_mu + 2 x G v_q + y G v_r); ``means`` holds the averages of the derivatives
    now."""
    H, n = x.shape
    for r in prange(H):
        row = np.empty((N_TERMS, stride), np.float32)
        for j in range(0, stride, LANES):
            for term in range(N_TERMS):
                store(row[term], j, _average_column(means[term], window, r, H, stride, j))
        for i in range(n):
            by_x = row[BY_MEAN, i] + _2 * x[r, i] * row[BY_SQUARE, i]
            gradient[r, i] = scale * (by_x + y[r, i] * row[BY_PRODUCT, i])
