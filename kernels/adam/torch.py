"""Adam without temporary copies of the parameter: two are made instead of ten.

What is computed once per call, whatever the backend.
"""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gsfusion_nb.optim.adam import ColumnRates
from gsfusion_nb.types import GaussianParams


def is_simple(*tensors: Tensor) -> bool:
    """Whether all are float32 without gaps, which is what the kernels take."""
    return all(t.dtype == torch.float32 and t.is_contiguous() for t in tensors)


def corrections(t: Any, beta1: float, beta2: float) -> tuple[Any, Any]:
    """1 / (1 - b1^t) and 1 / sqrt(1 - b2^t).

    Args:
        t: One step count, infinite for no correction, or an array or tensor with one per row, float64 (1 - b2^t loses
            its digits in float32).
    """
    return 1 / (1 - beta1**t), 1 / (1 - beta2**t) ** 0.5


def step_sizes(lr: float | Tensor, param: Tensor) -> Tensor:
    """The learning rate of each value of a row, float32 [W], where ``lr`` is or on the CPU."""
    rate = lr.to(torch.float32) if isinstance(lr, Tensor) else torch.tensor(lr, dtype=torch.float32)
    return rate.expand(param.shape[1:]).reshape(-1)


def update_columns(
    update: Callable[..., None],
    params: GaussianParams,
    gradients: GaussianParams,
    exp_avg: GaussianParams,
    exp_avg_sq: GaussianParams,
    steps: int | Tensor | None,
    *,
    rates: ColumnRates,
    **decay: float,
) -> None:
    """``adam_update_map`` by a backend's ``adam_update``, called for one column after the other."""
    for name, lr in rates.by_column(params.sh).items():
        columns = (getattr(rows, name) for rows in (params, gradients, exp_avg, exp_avg_sq))
        update(*columns, steps, lr=lr, **decay)


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
    """See ``gsfusion_nb.optim.adam_update``."""
    exp_avg.mul_(beta1).add_(gradient, alpha=1 - beta1)
    exp_avg_sq.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
    if isinstance(steps, Tensor):
        by_row = corrections(steps.double().view(-1, *[1] * (param.ndim - 1)), beta1, beta2)
        correction_1, correction_2 = (correction.to(param) for correction in by_row)
    else:
        correction_1, correction_2 = corrections(math.inf if steps is None else float(steps), beta1, beta2)
    step = exp_avg_sq.sqrt().mul_(correction_2).add_(eps)
    torch.div(exp_avg, step, out=step)
    param.sub_(step.mul_(lr * correction_1))


def adam_update_map(*operands: Any, **options: Any) -> None:
    """See ``gsfusion_nb.optim.adam_update_map``."""
    update_columns(adam_update, *operands, **options)
