"""What is computed once per call of Adam, whatever the backend."""

from typing import Any

import torch
from torch import Tensor


def is_simple(*tensors: Tensor) -> bool:
    """Whether all are float32 without gaps, which is what the kernels take."""
    return all(t.dtype == torch.float32 and t.is_contiguous() for t in tensors)


def corrections(t: Any, beta1: float, beta2: float) -> tuple[Any, Any]:
    """1 / (1 - b1^t) and 1 / sqrt(1 - b2^t).

    Args:
        t: One step count, infinite for no correction, or an array or tensor with one per row,
            float64 (1 - b2^t loses its digits in float32).
    """
    return 1 / (1 - beta1**t), 1 / (1 - beta2**t) ** 0.5


def step_sizes(lr: float | Tensor, param: Tensor) -> Tensor:
    """The learning rate of each value of a row, float32 [W], where ``lr`` is or on the CPU."""
    rate = lr.to(torch.float32) if isinstance(lr, Tensor) else torch.tensor(lr, dtype=torch.float32)
    return rate.expand(param.shape[1:]).reshape(-1)
