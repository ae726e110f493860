"""D-SSIM and its gradient: every window average is a row pass and a column pass over interleaved
colour.

A row is its 3 W values, so neighbours of one channel are 3 apart. The formulas are those of
``gsfusion_nb.optim.structural``. The eleven neighbours of a value come from the cache.
"""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false,
# reportIndexIssue=false pyright: reportGeneralTypeIssues=false

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsfusion_nb.optim import structural as reference

from ..runtime.triton.launch import device_of, launch, parts
from . import window as planes
from .window import window as window_weights

_BLOCK = 256
_WINDOW = tl.constexpr(reference.WINDOW_PX)
_HALF = tl.constexpr(reference.WINDOW_PX // 2)
_X, _Y, _XX, _YY, _XY = (
    tl.constexpr(n) for n in (planes.X, planes.Y, planes.XX, planes.YY, planes.XY)
)
_BY_MEAN = tl.constexpr(planes.BY_MEAN)
_BY_SQUARE = tl.constexpr(planes.BY_SQUARE)
_BY_PRODUCT = tl.constexpr(planes.BY_PRODUCT)
_N_TERMS = tl.constexpr(planes.N_TERMS)
_C1 = tl.constexpr(reference.C1)
_C2 = tl.constexpr(reference.C2)


def dssim_vjp(
    rgb: Tensor,
    target: Tensor,
    v_loss: float = 1.0,
) -> tuple[Tensor, Tensor]:
    """See ``gsfusion_nb.optim.dssim_vjp``."""
    if rgb.dtype != torch.float32 or target.dtype != torch.float32:
        return reference.dssim_vjp.reference(rgb, target, v_loss)
    device = device_of("dssim_vjp", rgb)
    window = window_weights(device)
    x = rgb.detach().contiguous()
    y = target.detach().contiguous()
    total = x.numel()
    stride = 3 * x.shape[1]
    programs = parts(total, _BLOCK)
    means = torch.empty(planes.N_MEANS, total, dtype=torch.float32, device=device)
    terms = torch.empty(planes.N_TERMS, total, dtype=torch.float32, device=device)
    similarity = torch.empty(programs, dtype=torch.float32, device=device)
    gradient = torch.empty(rgb.shape, dtype=torch.float32, device=device)
    shared = {
        "window": window,
        "means": means,
        "total": total,
        "stride": stride,
        "BLOCK": _BLOCK,
        "num_warps": 4,
    }
    launch(_rows, programs, device, x=x, y=y, **shared)
    launch(_differentiate, programs, device, terms=terms, similarity=similarity, **shared)
    launch(_rows_again, programs, device, terms=terms, **shared)
    launch(
        _combine,
        programs,
        device,
        x=x,
        y=y,
        gradient=gradient,
        scale=-float(v_loss) / total,
        **shared,
    )
    return (1.0 - similarity.sum(dtype=torch.float64) / total).float(), gradient


@triton.jit(do_not_specialize=["total", "stride"])
def _rows(x, y, window, means, total, stride, BLOCK: tl.constexpr):
    """Row averages of x, y, x^2, y^2 and x y."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    column = i % stride
    mx = tl.zeros([BLOCK], tl.float32)
    my = tl.zeros([BLOCK], tl.float32)
    xx = tl.zeros([BLOCK], tl.float32)
    yy = tl.zeros([BLOCK], tl.float32)
    xy = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(_WINDOW):
        shift = 3 * (k - _HALF)
        here = (i < total) & (column + shift >= 0) & (column + shift < stride)
        weight = tl.load(window + k)
        a = tl.load(x + i + shift, mask=here, other=0.0)
        b = tl.load(y + i + shift, mask=here, other=0.0)
        mx += weight * a
        my += weight * b
        xx += weight * (a * a)
        yy += weight * (b * b)
        xy += weight * (a * b)
    here = i < total
    tl.store(means + _X * total + i, mx, mask=here)
    tl.store(means + _Y * total + i, my, mask=here)
    tl.store(means + _XX * total + i, xx, mask=here)
    tl.store(means + _YY * total + i, yy, mask=here)
    tl.store(means + _XY * total + i, xy, mask=here)


@triton.jit
def _column(plane, window, i, total, stride):
    mean = 0.0 * i.to(tl.float32)
    for k in tl.static_range(_WINDOW):
        at = i + (k - _HALF) * stride
        mean += tl.load(window + k) * tl.load(plane + at, mask=(at >= 0) & (at < total), other=0.0)
    return mean


@triton.jit(do_not_specialize=["total", "stride"])
def _differentiate(means, window, terms, similarity, total, stride, BLOCK: tl.constexpr):
    """SSIM summed over each program, and its derivatives by mu_x, G x^2 and G x y."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < total
    mx = _column(means + _X * total, window, i, total, stride)
    my = _column(means + _Y * total, window, i, total, stride)
    xx = _column(means + _XX * total, window, i, total, stride)
    yy = _column(means + _YY * total, window, i, total, stride)
    xy = _column(means + _XY * total, window, i, total, stride)
    A1 = 2 * mx * my + _C1
    A2 = 2 * (xy - mx * my) + _C2
    B1 = mx * mx + my * my + _C1
    B2 = (xx - mx * mx) + (yy - my * my) + _C2
    S = A1 * A2 / (B1 * B2)
    tl.store(
        terms + _BY_MEAN * total + i,
        2 * my * (A2 - A1) / (B1 * B2) + 2 * mx * S * (1 / B2 - 1 / B1),
        mask=here,
    )
    tl.store(terms + _BY_SQUARE * total + i, -S / B2, mask=here)
    tl.store(terms + _BY_PRODUCT * total + i, 2 * A1 / (B1 * B2), mask=here)
    tl.store(similarity + tl.program_id(0), tl.sum(tl.where(here, S, 0.0), axis=0))


@triton.jit(do_not_specialize=["total", "stride"])
def _rows_again(terms, window, means, total, stride, BLOCK: tl.constexpr):
    """Row averages of the three derivatives."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    column = i % stride
    for plane in tl.static_range(_N_TERMS):
        mean = tl.zeros([BLOCK], tl.float32)
        for k in tl.static_range(_WINDOW):
            shift = 3 * (k - _HALF)
            here = (i < total) & (column + shift >= 0) & (column + shift < stride)
            mean += tl.load(window + k) * tl.load(
                terms + plane * total + i + shift, mask=here, other=0.0
            )
        tl.store(means + plane * total + i, mean, mask=i < total)


@triton.jit(do_not_specialize=["total", "stride", "scale"])
def _combine(
    means,
    x,
    y,
    window,
    gradient,
    total,
    stride,
    scale,
    BLOCK: tl.constexpr,
):
    """v_x = scale (G v_mu + 2 x G v_q + y G v_r); ``means`` holds the row averages of the
    derivatives now."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < total
    g_mu = _column(means + _BY_MEAN * total, window, i, total, stride)
    g_q = _column(means + _BY_SQUARE * total, window, i, total, stride)
    g_r = _column(means + _BY_PRODUCT * total, window, i, total, stride)
    a = tl.load(x + i, mask=here, other=0.0)
    b = tl.load(y + i, mask=here, other=0.0)
    tl.store(gradient + i, scale * (g_mu + 2 * a * g_q + b * g_r), mask=here)
