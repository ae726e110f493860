"""One pass of Adam over a parameter: each value, its gradient and its two moments are read and written once."""

# Arrays are passed on as a list, which pyright cannot follow:
# pyright: reportCallIssue=false

import math

import numpy as np
from numba import njit, prange
from torch import Tensor

from ..runtime.numba.launch import launching
from .host import corrections, is_simple, step_sizes
from .torch import adam_update as vectorised

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
    if not is_simple(*tensors):
        vectorised(*tensors, steps, lr=lr, beta1=beta1, beta2=beta2, eps=eps)
        return
    if param.numel() == 0:
        return
    arrays = [t.detach().view(param.shape[0], -1).numpy() for t in tensors]
    rate = step_sizes(lr, param).contiguous().numpy()
    t = np.atleast_1d(np.inf if steps is None else np.asarray(steps, np.float64))
    correction_1, correction_2 = corrections(t, beta1, beta2)
    with launching():
        moments = f32(beta1), f32(1 - beta1), f32(beta2), f32(1 - beta2)
        _update(*arrays, correction_1.astype(np.float32), correction_2.astype(np.float32), rate, *moments, f32(eps))


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
