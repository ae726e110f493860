"""Loss of a picture's depth and its gradient in two passes over the image: count and add up, then
write.

The second pass takes the count from the device; the host waits for nothing.
"""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false,
# reportIndexIssue=false

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsfusion_nb.backends import load
from gsfusion_nb.optim.depth_loss import LEAST_ALPHA, DepthLoss

from ..runtime.triton.launch import device_of, launch, parts

_BLOCK = 1024
_LEAST_ALPHA = tl.constexpr(LEAST_ALPHA)
_PIXELS, _ERROR, _HOLES = (tl.constexpr(n) for n in range(3))
"""What the kernels add up: pixels with measured depth, sum w |D^ / a - D|, sum w D (1 - A)."""
_N_SUMS = tl.constexpr(3)


def expected_depth_loss(
    depth_m: Tensor,
    alpha: Tensor,
    target_m: Tensor,
    coverage: float = 0.0,
    far_m: float = math.inf,
    weight: float = 1.0,
) -> DepthLoss:
    """See ``gsfusion_nb.optim.expected_depth_loss``."""
    if depth_m.dtype != torch.float32:
        plain = load("expected_depth_loss", "reference")
        return plain(depth_m, alpha, target_m, coverage, far_m, weight)
    device = device_of("expected_depth_loss", depth_m)
    v_depth_m, v_alpha = torch.empty(2, *depth_m.shape, dtype=torch.float32, device=device)
    total = depth_m.numel()
    shared = {
        "depth_m": depth_m.detach().contiguous(),
        "alpha": alpha.detach().contiguous(),
        "target_m": target_m.contiguous(),
        "far": float(far_m),
        "total": total,
        "BLOCK": _BLOCK,
        "num_warps": 4,
    }
    sums = torch.zeros(parts(total, _BLOCK), _N_SUMS.value, dtype=torch.float32, device=device)
    launch(_sums, len(sums), device, sums=sums, **shared)
    sums = sums.sum(0, dtype=torch.float64)
    n = sums[_PIXELS.value].clamp_min(1.0)
    launch(
        _write,
        parts(total, _BLOCK),
        device,
        n_measured=n,
        v_depth=v_depth_m,
        v_alpha=v_alpha,
        weight=float(weight),
        hole_weight=float(weight * coverage),
        **shared,
    )
    value = weight * (sums[_ERROR.value] + coverage * sums[_HOLES.value]) / n
    return DepthLoss(value=value.float(), v_depth_m=v_depth_m, v_alpha=v_alpha)


@triton.jit
def _errors(depth_m, alpha, target_m, at, total, far):
    """Depth, alpha, measured depth, the divisor and the weight of pixels, and D^ / a - D, 0 where
    nothing was measured."""
    here = at < total
    d = tl.load(depth_m + at, mask=here, other=0.0)
    a = tl.load(alpha + at, mask=here, other=1.0)
    target = tl.load(target_m + at, mask=here, other=0.0)
    divisor = tl.maximum(a, _LEAST_ALPHA)
    ratio = far / tl.where(target > 0, target, 1.0)
    w = tl.where(target > far, ratio * ratio, 1.0)
    return d, a, target, divisor, w, tl.where(target > 0, d / divisor - target, 0.0)


@triton.jit(do_not_specialize=["total", "far"])
def _sums(depth_m, alpha, target_m, sums, total, far, BLOCK: tl.constexpr):
    """The three sums, of each program."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    _, a, target, _, w, error = _errors(depth_m, alpha, target_m, at, total, far)
    out = sums + _N_SUMS * tl.program_id(0)
    tl.store(out + _PIXELS, tl.sum((target > 0).to(tl.float32), axis=0))
    tl.store(out + _ERROR, tl.sum(w * tl.abs(error), axis=0))
    tl.store(out + _HOLES, tl.sum(w * target * (1.0 - a), axis=0))


@triton.jit(do_not_specialize=["total", "far", "weight", "hole_weight"])
def _write(
    depth_m,
    alpha,
    target_m,
    n_measured,
    v_depth,
    v_alpha,
    total,
    far,
    weight,
    hole_weight,
    BLOCK: tl.constexpr,
):
    """The two gradient images; every pixel is written."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = at < total
    d, a, target, divisor, w, error = _errors(depth_m, alpha, target_m, at, total, far)
    n = tl.load(n_measured).to(tl.float32)
    sign = tl.where(error > 0, 1.0, tl.where(error < 0, -1.0, 0.0))
    v = weight * sign / (n * divisor)
    over = tl.where(a < _LEAST_ALPHA, 0.0, -v * d / divisor)
    tl.store(v_depth + at, w * v, mask=here)
    tl.store(v_alpha + at, w * (over - hole_weight * target / n), mask=here)
