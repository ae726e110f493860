"""One pass of Adam over a parameter: each value, its gradient and its two moments are read and
written once."""

# Arrays are passed on as a list, which pyright cannot follow:
# pyright: reportCallIssue=false

import math

import numpy as np
from numba import njit, prange
from torch import Tensor
from torch.autograd.graph import increment_version

from gsfusion_nb.backends import load
from gsfusion_nb.optim.adam import ColumnRates
from gsfusion_nb.optim.adam import adam_update as reference
from gsfusion_nb.types import GaussianParams

from ..runtime.numba.launch import launching
from .host import corrections, is_simple, step_sizes

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
        reference.reference(*tensors, steps, lr=lr, beta1=beta1, beta2=beta2, eps=eps)
        return
    if param.numel() == 0:
        return
    with launching():
        _take_step(tensors, lr, *_shared_by_columns(steps, beta1, beta2, eps))


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
    maps = (params, gradients, exp_avg, exp_avg_sq)
    if not all(
        is_simple(*columns) for columns in zip(*(vars(m).values() for m in maps), strict=True)
    ):
        decay = {"beta1": beta1, "beta2": beta2, "eps": eps}
        load("adam_update_map", "reference")(*maps, steps, rates=rates, **decay)
        return
    if len(params) == 0:
        return
    shared = _shared_by_columns(steps, beta1, beta2, eps)
    with launching():
        for name, lr in rates.by_column(params.sh).items():
            _take_step(tuple(getattr(m, name) for m in maps), lr, *shared)


def _shared_by_columns(
    steps: int | Tensor | None, beta1: float, beta2: float, eps: float
) -> tuple[tuple[np.ndarray, ...], tuple[np.float32, ...]]:
    """``corrections`` and ``decay`` of ``_update``."""
    t = np.atleast_1d(np.inf if steps is None else np.asarray(steps, np.float64))
    by_row = tuple(correction.astype(np.float32) for correction in corrections(t, beta1, beta2))
    return by_row, tuple(map(f32, (beta1, 1 - beta1, beta2, 1 - beta2, eps)))


def _take_step(
    tensors: tuple[Tensor, ...],
    lr: float | Tensor,
    by_row: tuple[np.ndarray, ...],
    decay: tuple[np.float32, ...],
) -> None:
    """One step of a column: parameter, gradient and moments; only inside ``launching``."""
    param = tensors[0]
    arrays = tuple(t.detach().view(len(param), -1).numpy() for t in tensors)
    _update(arrays, by_row, step_sizes(lr, param).contiguous().numpy(), decay)
    increment_version(param)


@njit(parallel=True, cache=True, error_model="numpy")
def _update(tensors, corrections, rate, decay):
    """One step. corrections: 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t) of every row [N], or of
    all [1]. rate: of each value of a row [W]. decay: what is kept of each moment, and the share of
    the new value; eps."""
    param, gradient, exp_avg, exp_avg_sq = tensors
    correction_1, correction_2 = corrections
    beta1, rest1, beta2, rest2, eps = decay
    N, width = param.shape
    per_row = correction_1.shape[0] > 1
    chunk = 1024
    for part in prange((N + chunk - 1) // chunk):
        for i in range(part * chunk, min(N, part * chunk + chunk)):
            row = i if per_row else 0
            c1 = correction_1[row]
            c2 = correction_2[row]
            p = param[i]
            g = gradient[i]
            m = exp_avg[i]
            v = exp_avg_sq[i]
            for j in range(width):
                m[j] = beta1 * m[j] + rest1 * g[j]
                v[j] = beta2 * v[j] + rest2 * g[j] * g[j]
                p[j] -= rate[j] * c1 * m[j] / (math.sqrt(v[j]) * c2 + eps)
