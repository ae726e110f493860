"""One pass of Adam over a parameter: each value, its gradient and its two moments are read and written once."""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportIndexIssue=false

import math

import triton
import triton.language as tl
from torch import Tensor

from ..runtime.triton.launch import device_of, launch, parts
from .host import corrections, is_simple, step_sizes
from .torch import adam_update as vectorised

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
    if not is_simple(*tensors):
        vectorised(*tensors, steps, lr=lr, beta1=beta1, beta2=beta2, eps=eps)
        return
    per_row = steps if isinstance(steps, Tensor) else None
    device = device_of(
        "adam_update", param=param, gradient=gradient, exp_avg=exp_avg, exp_avg_sq=exp_avg_sq, steps=per_row
    )
    by_place = isinstance(lr, Tensor)
    c1, c2 = corrections(math.inf if steps is None else float(steps), beta1, beta2) if per_row is None else (1.0, 1.0)
    by_row = (param, param)
    if per_row is not None:
        by_row = tuple(c.float() for c in corrections(per_row.double(), beta1, beta2))
    total = param.numel()
    launch(
        _update,
        parts(total, _BLOCK),
        device,
        param=param,
        gradient=gradient,
        exp_avg=exp_avg,
        exp_avg_sq=exp_avg_sq,
        rate=step_sizes(lr, param).to(device).contiguous() if by_place else param,
        correction_1=by_row[0],
        correction_2=by_row[1],
        total=total,
        width=total // max(param.shape[0], 1),
        lr=0.0 if by_place else float(lr),
        c1=c1,
        c2=c2,
        beta1=float(beta1),
        one_minus_beta1=float(1 - beta1),
        beta2=float(beta2),
        one_minus_beta2=float(1 - beta2),
        eps=float(eps),
        RATES=by_place,
        PER_ROW=per_row is not None,
        BLOCK=_BLOCK,
        num_warps=4,
    )


@triton.jit(
    do_not_specialize=[
        "total",
        "width",
        "lr",
        "c1",
        "c2",
        "beta1",
        "one_minus_beta1",
        "beta2",
        "one_minus_beta2",
        "eps",
    ]
)
def _update(
    param, gradient, exp_avg, exp_avg_sq, rate, correction_1, correction_2, total, width, lr, c1, c2,
    beta1, one_minus_beta1, beta2, one_minus_beta2, eps, RATES: tl.constexpr, PER_ROW: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Step sizes and corrections are for all rows, ``lr``, ``c1`` and ``c2``, or read from ``rate`` by the place in a
    row, and from ``correction_1`` and ``correction_2`` by row."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = i < total
    g = tl.load(gradient + i, mask=here, other=0.0)
    m = beta1 * tl.load(exp_avg + i, mask=here, other=0.0) + one_minus_beta1 * g
    v = beta2 * tl.load(exp_avg_sq + i, mask=here, other=0.0) + one_minus_beta2 * g * g
    tl.store(exp_avg + i, m, mask=here)
    tl.store(exp_avg_sq + i, v, mask=here)
    if PER_ROW:
        c1 = tl.load(correction_1 + i // width, mask=here, other=1.0)
        c2 = tl.load(correction_2 + i // width, mask=here, other=1.0)
    if RATES:
        lr = tl.load(rate + i % width, mask=here, other=0.0)
    p = tl.load(param + i, mask=here, other=0.0)
    tl.store(param + i, p - lr * c1 * m / (tl.sqrt(v) * c2 + eps), mask=here)
