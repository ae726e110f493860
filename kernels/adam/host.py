"""What is computed once per call, whatever the backend."""

import math

import torch
from torch import Tensor


def is_simple(*tensors: Tensor) -> bool:
    """Whether all are float32 without gaps, which is what the kernels take."""
    return all(t.dtype == torch.float32 and t.is_contiguous() for t in tensors)


def corrections(steps: int | Tensor | None, beta1: float, beta2: float) -> tuple[float | Tensor, float | Tensor]:
    """1 / (1 - b1^t) and 1 / sqrt(1 - b2^t): numbers, or float64 [N] if every row has its own count."""
    if isinstance(steps, Tensor):
        t = steps.double()
        remaining_1, remaining_2 = (-torch.expm1(t * _log(beta)) for beta in (beta1, beta2))  # 1 - b^t
        return 1 / remaining_1, remaining_2.rsqrt()
    t = math.inf if steps is None else steps
    return 1 / (1 - beta1**t), 1 / math.sqrt(1 - beta2**t)


def _log(beta: float) -> float:
    return math.log(beta) if beta > 0 else -math.inf


def step_sizes(lr: float | Tensor, param: Tensor) -> Tensor:
    """The learning rate of each value of a row, float32 [W], where ``lr`` is or on the CPU."""
    rate = torch.as_tensor(lr, dtype=torch.float32)
    return rate.expand(param.shape[1:]).reshape(-1)
