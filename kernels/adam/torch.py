"""Adam without temporary copies of the parameter: two are made instead of ten."""

import math
from typing import Any

import torch
from torch import Tensor

from .host import corrections, update_columns


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
