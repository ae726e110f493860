"""Adam in CUDA, ``adam.cu``: one launch for all columns of a map, or for one parameter."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gsfusion_nb.optim.adam import ColumnRates
from gsfusion_nb.types import GaussianParams

from ..runtime.arguments import parts
from ..runtime.cuda.launch import device_of, launch
from .torch import adam_update as vectorised
from .torch import corrections, is_simple, step_sizes, update_columns

_BLOCK = 256
_NUMBERS = 4 * _BLOCK
"""Of a column that a block updates."""
_MOST_NUMBERS = 2**31 - _NUMBERS
"""The kernels count the numbers of a parameter in 32 bits; a map has fewer."""


class Columns(NamedTuple):
    """The columns of a map, of its gradient or of a moment. float32"""

    xyz_W: Tensor
    log_scale: Tensor
    quat: Tensor
    opacity_logit: Tensor
    sh: Tensor


class Column(NamedTuple):
    """One parameter. float32"""

    param: Tensor
    gradient: Tensor
    exp_avg: Tensor
    exp_avg_sq: Tensor


class Steps(NamedTuple):
    """The step count of every row, int32 or int64; with neither, the corrections of all rows (``host.corrections``)."""

    of_row: Tensor | None
    of_row_64: Tensor | None
    ln_beta1: float
    ln_beta2: float
    first: float
    second: float


class Decay(NamedTuple):
    """Of the moments: what is kept of the old value, and the share of the new one; ``eps`` as in ``adam_update``."""

    beta1: float
    one_minus_beta1: float
    beta2: float
    one_minus_beta2: float
    eps: float


def adam_update_map(
    params: GaussianParams,
    gradients: GaussianParams,
    exp_avg: GaussianParams,
    exp_avg_sq: GaussianParams,
    steps: int | Tensor | None,
    *,
    rates: ColumnRates,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """See ``gsfusion_nb.optim.adam_update_map``."""
    operation = "adam_update_map"
    device_of(operation, params=params.xyz_W)
    groups = [Columns(**vars(rows)) for rows in (params, gradients, exp_avg, exp_avg_sq)]
    is_float32 = params.xyz_W.dtype == torch.float32  # and all others are of the same type
    if not (is_float32 and all(column.is_contiguous() for group in groups for column in group)):
        update_columns(
            adam_update, params, gradients, exp_avg, exp_avg_sq, steps, rates=rates, beta1=beta1, beta2=beta2, eps=eps
        )
        return
    N, K = len(params), params.sh.shape[1]
    blocks = 2 * parts(3 * N, _NUMBERS) + parts(4 * N, _NUMBERS) + parts(N, _NUMBERS) + parts(3 * K * N, _NUMBERS)
    counts, decay = _steps(steps, beta1, beta2), _decay(beta1, beta2, eps)
    launch(operation, "adam:update_map", blocks, _BLOCK, *groups, rates, counts, decay, N, K)


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
    device, total = device_of("adam_update", param=param), param.numel()
    column = Column(param, gradient, exp_avg, exp_avg_sq)
    if not is_simple(*column) or total > _MOST_NUMBERS:
        vectorised(*column, steps, lr=lr, beta1=beta1, beta2=beta2, eps=eps)
        return
    rate, lr = (step_sizes(lr, param).to(device).contiguous(), 0.0) if isinstance(lr, Tensor) else (None, float(lr))
    launch(
        "adam_update",
        "adam:update_parameter",
        parts(total, _NUMBERS),
        _BLOCK,
        column,
        rate,
        lr,
        _steps(steps, beta1, beta2),
        _decay(beta1, beta2, eps),
        total,
        total // max(len(param), 1),
    )


def _steps(steps: int | Tensor | None, beta1: float, beta2: float) -> Steps:
    if not isinstance(steps, Tensor):
        first, second = corrections(math.inf if steps is None else float(steps), beta1, beta2)
        return Steps(of_row=None, of_row_64=None, ln_beta1=0.0, ln_beta2=0.0, first=first, second=second)
    steps, is_long = steps.contiguous(), steps.dtype == torch.int64
    return Steps(
        of_row=None if is_long else steps,
        of_row_64=steps if is_long else None,
        ln_beta1=_ln(beta1),
        ln_beta2=_ln(beta2),
        first=0.0,
        second=0.0,
    )


def _ln(beta: float) -> float:
    return math.log(beta) if beta > 0 else -math.inf


def _decay(beta1: float, beta2: float, eps: float) -> Decay:
    return Decay(beta1=beta1, one_minus_beta1=1 - beta1, beta2=beta2, one_minus_beta2=1 - beta2, eps=eps)
