"""What is computed once per call, whatever the backend."""

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
