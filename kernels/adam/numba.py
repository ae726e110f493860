"""One pass of Adam over a parameter: each value, its gradient and its two moments are read and written once."""

# Arrays are passed on as a list, which pyright cannot follow:
# pyright: reportCallIssue=false

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.optim import adam as reference

from ..runtime.numba.launch import launching

f32 = np.float32


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
    tensors = (param, gradient, exp_avg, exp_avg_sq)
    if param.dtype != torch.float32 or not all(t.is_contiguous() for t in tensors):
        reference.adam_update.reference(*tensors, steps, lr=lr, beta1=beta1, beta2=beta2, eps=eps)
        return
    N = param.shape[0]
    if param.numel() == 0:
        return
    arrays = [t.detach().view(N, -1).numpy() for t in tensors]
    width = arrays[0].shape[1]
    rate = np.empty(width, np.float32)
    rate[:] = lr if isinstance(lr, (int, float)) else lr.expand(param.shape[1:]).reshape(-1).numpy()
    t = np.inf if steps is None else np.asarray(steps, np.float64)
    correction_1 = np.atleast_1d(1 / (1 - beta1**t)).astype(np.float32)
    correction_2 = np.atleast_1d(1 / np.sqrt(1 - beta2**t)).astype(np.float32)
    with launching():
        moments = f32(beta1), f32(1 - beta1), f32(beta2), f32(1 - beta2)
        _update(*arrays, correction_1, correction_2, rate, *moments, f32(eps))


@njit(parallel=True, cache=True, error_model="numpy")
def _update(param, gradient, exp_avg, exp_avg_sq, correction_1, correction_2, rate, beta1, rest1, beta2, rest2, eps):
    """Corrections [1] or [N]: 1 / (1 - b1^t) and 1 / sqrt(1 - b2^t). rate [W]."""
    N, width = param.shape
    per_row = correction_1.shape[0] > 1
    chunk = 1024
    for part in prange((N + chunk - 1) // chunk):
        for i in range(part * chunk, min(N, part * chunk + chunk)):
            row = i if per_row else 0
            c1, c2 = correction_1[row], correction_2[row]
            p, g, m, v = param[i], gradient[i], exp_avg[i], exp_avg_sq[i]
            for j in range(width):
                m[j] = beta1 * m[j] + rest1 * g[j]
                v[j] = beta2 * v[j] + rest2 * g[j] * g[j]
                p[j] -= rate[j] * c1 * m[j] / (math.sqrt(v[j]) * c2 + eps)
