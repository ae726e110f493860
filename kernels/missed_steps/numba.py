"""The steps that rows missed, in one pass over each column of a map."""

# Arrays are passed on as a list, which pyright cannot follow:
# pyright: reportCallIssue=false

import math

import numpy as np
from numba import njit, prange
from torch import Tensor
from torch.autograd.graph import increment_version

from gsfusion_nb.backends import load
from gsfusion_nb.optim.adam import ColumnRates
from gsfusion_nb.types import GaussianParams

from ..adam.host import is_simple, step_sizes
from ..runtime.numba.launch import launching

f32 = np.float32
_ZERO = f32(0.0)
_ONE = f32(1.0)


def missed_steps_map(
    params: GaussianParams,
    exp_avg: GaussianParams,
    exp_avg_sq: GaussianParams,
    distance: Tensor,
    decay1: Tensor,
    decay2: Tensor,
    *,
    rates: ColumnRates,
    eps: float,
) -> None:
    """See ``gsfusion_nb.optim.missed_steps``."""
    maps = (params, exp_avg, exp_avg_sq)
    of_rows = (distance, decay1, decay2)
    if not all(is_simple(*vars(rows).values()) for rows in maps):
        load("missed_steps_map", "reference")(*maps, *of_rows, rates=rates, eps=eps)
        return
    if not len(params):
        return
    factors = tuple(values.float().contiguous().numpy() for values in of_rows)
    with launching():
        for name, lr in rates.by_column(params.sh).items():
            columns = [getattr(rows, name) for rows in maps]
            arrays = tuple(x.detach().numpy().reshape(len(x), -1) for x in columns)
            rate = step_sizes(lr, columns[0]).contiguous().numpy()
            _take(arrays, factors, rate, f32(eps))
            increment_version(columns)


@njit(parallel=True, cache=True, error_model="numpy")
def _take(column, factors, rate, eps):
    """One column [R, W]: values, m and v. factors: distance and both decays of each row [R]. rate:
    of each value of a row [W]."""
    param, exp_avg, exp_avg_sq = column
    distance, decay1, decay2 = factors
    R, width = param.shape
    chunk = 1024
    for part in prange((R + chunk - 1) // chunk):
        for i in range(part * chunk, min(R, part * chunk + chunk)):
            if distance[i] == _ZERO and decay1[i] == _ONE and decay2[i] == _ONE:
                continue
            p = param[i]
            m = exp_avg[i]
            v = exp_avg_sq[i]
            for j in range(width):
                p[j] -= rate[j] * distance[i] * m[j] / (math.sqrt(v[j]) + eps)
                m[j] *= decay1[i]
                v[j] *= decay2[i]
