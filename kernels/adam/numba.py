"""One pass of Adam over a parameter: each value, its gradient and its two moments are read and written once."""

# Arrays are passed on as a list, which pyright cannot follow:
# pyright: reportCallIssue=false

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.backends import load
from gsfusion_nb.optim.adam import adam_update as reference

from ..runtime.numba.launch import launching
from .host import corrections, is_simple, step_sizes

f32 = np.float32


class Tensors(NamedTuple):
    """A parameter, its gradient and its two moments, [N, W] each. float32"""

    param: np.ndarray
    gradient: np.ndarray
    exp_avg: np.ndarray
    exp_avg_sq: np.ndarray


class Corrections(NamedTuple):
    """1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t) of every row [N], or of all [1]. float32"""

    first: np.ndarray
    second: np.ndarray


class Decay(NamedTuple):
    """Of the moments: what is kept of the old value, and the share of the new one; ``eps`` as in ``adam_update``."""

    beta1: np.float32
    one_minus_beta1: np.float32
    beta2: np.float32
    one_minus_beta2: np.float32
    eps: np.float32


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
        reference.reference(*tensors, steps, lr=lr, beta1=beta1, beta2=beta2, eps=eps)
        return
    if param.numel() == 0:
        return
    arrays = Tensors(*(t.detach().view(param.shape[0], -1).numpy() for t in tensors))
    rate = step_sizes(lr, param).contiguous().numpy()
    t = np.atleast_1d(np.inf if steps is None else np.asarray(steps, np.float64))
    by_row = Corrections(*(correction.astype(np.float32) for correction in corrections(t, beta1, beta2)))
    decay = Decay(
        beta1=f32(beta1), one_minus_beta1=f32(1 - beta1), beta2=f32(beta2), one_minus_beta2=f32(1 - beta2), eps=f32(eps)
    )
    with launching():
        _update(arrays, by_row, rate, decay)


def adam_update_map(*operands: Any, **options: Any) -> None:
    """See ``gsfusion_nb.optim.adam_update_map``: it is that function, whose columns are updated on this backend."""
    load("adam_update_map", "reference")(*operands, **options)


@njit(parallel=True, cache=True, error_model="numpy")
def _update(tensors, corrections, rate, decay):
    """One step. rate: of each value of a row [W]."""
    param, gradient = tensors.param, tensors.gradient
    exp_avg, exp_avg_sq = tensors.exp_avg, tensors.exp_avg_sq
    correction_1, correction_2 = corrections.first, corrections.second
    beta1, rest1, beta2, rest2 = decay.beta1, decay.one_minus_beta1, decay.beta2, decay.one_minus_beta2
    eps = decay.eps
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
