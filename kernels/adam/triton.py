"""One pass of Adam over a parameter: each value, its gradient and its two moments are read and written once."""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportIndexIssue=false

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsfusion_nb.optim import adam as reference

from ..runtime.triton.launch import device_of, launch, parts

_BLOCK = 1024


def adam_update(
    param: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    steps: int | Tensor | None,
    *,
    lr: float | Tensor,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """See ``gsfusion_nb.optim.adam_update``. ``lr`` may be on any device."""
    tensors = (param, gradient, exp_avg, exp_avg_sq)
    if any(t.dtype != torch.float32 or not t.is_contiguous() for t in tensors):
        reference.adam_update.reference(*tensors, steps, lr=lr, beta1=beta1, beta2=beta2, eps=eps)
        return
    per_row = steps if isinstance(steps, Tensor) else None
    device = device_of(
        "adam_update", param=param, gradient=gradient, exp_avg=exp_avg, exp_avg_sq=exp_avg_sq, steps=per_row
    )
    total = param.numel()
    width = total // max(param.shape[0], 1)
    rate, corrections = param, (param, param)
    if isinstance(lr, Tensor):
        rate = lr.to(device, torch.float32).expand(param.shape[1:]).contiguous()
    correction_1 = correction_2 = 1.0
    if per_row is not None:
        t = per_row.double()  # 1 - b2^t loses its digits in float32
        corrections = (1 / (1 - beta1**t)).float(), (1 / (1 - beta2**t).sqrt()).float()
    elif steps is not None:
        correction_1, correction_2 = 1 / (1 - beta1**steps), 1 / math.sqrt(1 - beta2**steps)
    launch(
        _update, parts(total, _BLOCK), device, *tensors, rate, *corrections, total, width,
        0.0 if isinstance(lr, Tensor) else float(lr), float(correction_1), float(correction_2),
        float(beta1), float(1 - beta1), float(beta2), float(1 - beta2), float(eps),
        RATES=isinstance(lr, Tensor), PER_ROW=per_row is not None, BLOCK=_BLOCK, num_warps=4,
    )  # fmt: skip


@triton.jit(do_not_specialize=["total", "width", "lr", "c1", "c2", "beta1", "rest1", "beta2", "rest2", "eps"])
def _update(
    param, gradient, exp_avg, exp_avg_sq, rate, correction_1, correction_2, total, width, lr, c1, c2,
    beta1, rest1, beta2, rest2, eps, RATES: tl.constexpr, PER_ROW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Corrections: 1 / (1 - b1^t) and 1 / sqrt(1 - b2^t), for all rows or one per row."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = i < total
    g = tl.load(gradient + i, mask=here, other=0.0)
    m = beta1 * tl.load(exp_avg + i, mask=here, other=0.0) + rest1 * g
    v = beta2 * tl.load(exp_avg_sq + i, mask=here, other=0.0) + rest2 * g * g
    tl.store(exp_avg + i, m, mask=here)
    tl.store(exp_avg_sq + i, v, mask=here)
    if PER_ROW:
        c1 = tl.load(correction_1 + i // width, mask=here, other=1.0)
        c2 = tl.load(correction_2 + i // width, mask=here, other=1.0)
    if RATES:
        lr = tl.load(rate + i % width, mask=here, other=0.0)
    p = tl.load(param + i, mask=here, other=0.0)
    tl.store(param + i, p - lr * c1 * m / (tl.sqrt(v) * c2 + eps), mask=here)
