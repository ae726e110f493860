"""One pass of Adam over a parameter: each value, its gradient and its two moments are read and written once."""

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.optim import adam as reference

from .launch import launching

f32 = np.float32
_ONE = f32(1.0)
_NO_CORRECTION = 1 << 24
"""A step count at which b^t is zero in float32."""


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
    if steps is None:
        steps = _NO_CORRECTION
    t = np.asarray([steps], np.int32) if isinstance(steps, int) else steps.numpy().astype(np.int32)
    with launching():
        _update(*arrays, t, rate, f32(beta1), f32(beta2), f32(1 - beta1), f32(1 - beta2), f32(eps))


@njit(parallel=True, cache=True, error_model="numpy")
def _update(param, gradient, exp_avg, exp_avg_sq, steps, rate, beta1, beta2, one_minus_1, one_minus_2, eps):
    N, width = param.shape
    chunk = 1024
    for part in prange((N + chunk - 1) // chunk):
        correction_1 = _ONE / (_ONE - beta1 ** f32(steps[0]))
        correction_2 = _ONE / math.sqrt(_ONE - beta2 ** f32(steps[0]))
        for i in range(part * chunk, min(N, part * chunk + chunk)):
            if steps.shape[0] > 1:
                correction_1 = _ONE / (_ONE - beta1 ** f32(steps[i]))
                correction_2 = _ONE / math.sqrt(_ONE - beta2 ** f32(steps[i]))
            p, g, m, v = param[i], gradient[i], exp_avg[i], exp_avg_sq[i]
            for j in range(width):
                m[j] = beta1 * m[j] + one_minus_1 * g[j]
                v[j] = beta2 * v[j] + one_minus_2 * g[j] * g[j]
                p[j] -= rate[j] * correction_1 * m[j] / (math.sqrt(v[j]) * correction_2 + eps)
