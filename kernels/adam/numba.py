"""One pass of Adam over a parameter, or over all columns of a map: each value, its gradient and its
two moments are read and written once."""

# Arrays are passed on as a list, which pyright cannot follow:
# pyright: reportCallIssue=false

import math
from collections.abc import Sequence

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
    _take_step([tensors], [lr], steps, beta1, beta2, eps)


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
    columns = list(zip(*(vars(rows).values() for rows in maps), strict=True))
    if not all(is_simple(*tensors) for tensors in columns):
        decay = {"beta1": beta1, "beta2": beta2, "eps": eps}
        load("adam_update_map", "reference")(*maps, steps, rates=rates, **decay)
        return
    if len(params):
        by_column = rates.by_column(params.sh)
        if params.sh.shape[1] == 1:
            by_column["sh"] = rates.sh_dc
        _take_step(columns, [by_column[name] for name in vars(params)], steps, beta1, beta2, eps)


def _take_step(
    columns: Sequence[tuple[Tensor, ...]],
    rates: Sequence[float | Tensor],
    steps: int | Tensor | None,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """One step of columns of the same rows. columns: parameter, gradient and moments of each."""
    t = np.atleast_1d(np.inf if steps is None else np.asarray(steps, np.float64))
    by_row = tuple(correction.astype(np.float32) for correction in corrections(t, beta1, beta2))
    decay = tuple(map(f32, (beta1, 1 - beta1, beta2, 1 - beta2, eps)))
    with launching():
        for tensors, lr in zip(columns, rates, strict=True):
            arrays = [tensor.detach().numpy() for tensor in tensors]
            if isinstance(lr, float) and len(t) == 1:
                values = tuple(array.reshape(-1) for array in arrays)
                _update_values(values, by_row, f32(lr), decay)
            else:
                rows = tuple(array.reshape(len(array), -1) for array in arrays)
                rate = step_sizes(lr, tensors[0]).contiguous().numpy()
                _update_rows(rows, by_row, rate, decay)
            increment_version(tensors[0])


@njit(parallel=True, cache=True, error_model="numpy")
def _update_values(values, corrections, rate, decay):
    """One step of values that share all but their gradients and moments; arguments as for
    ``_update_rows``."""
    param, gradient, exp_avg, exp_avg_sq = values
    correction_1, correction_2 = corrections
    c1 = correction_1[0]
    c2 = correction_2[0]
    beta1, rest1, beta2, rest2, eps = decay
    n = len(param)
    chunk = 4096
    for part in prange((n + chunk - 1) // chunk):
        first = part * chunk
        end = min(n, first + chunk)
        p = param[first:end]
        g = gradient[first:end]
        m = exp_avg[first:end]
        v = exp_avg_sq[first:end]
        for j in range(end - first):
            m[j] = beta1 * m[j] + rest1 * g[j]
            v[j] = beta2 * v[j] + rest2 * g[j] * g[j]
            p[j] -= rate * c1 * m[j] / (math.sqrt(v[j]) * c2 + eps)


@njit(parallel=True, cache=True, error_model="numpy")
def _update_rows(rows, corrections, rate, decay):
    """One step. corrections: 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t) of every row [N], or of
    all [1]. rate: of each value of a row [W]. decay: what is kept of each moment, and the share of
    the new value; eps."""
    param, gradient, exp_avg, exp_avg_sq = rows
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
