"""Adam in CUDA, ``adam.cu``: one launch for all columns of a map, or for one parameter."""

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.graph import increment_version

from gsfusion_nb.backends import load
from gsfusion_nb.optim.adam import ColumnRates
from gsfusion_nb.optim.adam import adam_update as reference
from gsfusion_nb.types import GaussianParams

from ..runtime.arguments import parts
from ..runtime.cuda.launch import device_of, launch
from .host import corrections, is_simple, step_sizes

_BLOCK = 256
_NUMBERS = 4 * _BLOCK
"""Of a column that a block updates."""
_MOST_NUMBERS = 2**31 - _NUMBERS
"""The kernels count the numbers of a parameter in 32 bits; a map has fewer."""


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
    operation = "adam_update_map"
    device_of(operation, params.xyz_W)
    groups = [vars(rows) for rows in (params, gradients, exp_avg, exp_avg_sq)]
    is_float32 = params.xyz_W.dtype == torch.float32  # and all others are of the same type
    if not (
        is_float32 and all(column.is_contiguous() for group in groups for column in group.values())
    ):
        each_column = load(operation, "reference")
        each_column(
            params,
            gradients,
            exp_avg,
            exp_avg_sq,
            steps,
            rates=rates,
            beta1=beta1,
            beta2=beta2,
            eps=eps,
        )
        return
    N = len(params)
    K = params.sh.shape[1]
    blocks = (
        2 * parts(3 * N, _NUMBERS)
        + parts(4 * N, _NUMBERS)
        + parts(N, _NUMBERS)
        + parts(3 * K * N, _NUMBERS)
    )
    counts = _steps(steps, beta1, beta2)
    decay = _decay(beta1, beta2, eps)
    launch(
        operation, "adam:update_map", blocks, _BLOCK, *groups, rates._asdict(), counts, decay, N, K
    )
    for column in groups[0].values():
        increment_version(column)


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
    """See ``gsfusion_nb.optim.adam_update``. ``lr`` may be on any device."""
    device = device_of("adam_update", param)
    total = param.numel()
    column = {"param": param, "gradient": gradient, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}
    if not is_simple(*column.values()) or total > _MOST_NUMBERS:
        reference.reference(**column, steps=steps, lr=lr, beta1=beta1, beta2=beta2, eps=eps)
        return
    rate, lr = (
        (step_sizes(lr, param).to(device).contiguous(), 0.0)
        if isinstance(lr, Tensor)
        else (None, float(lr))
    )
    counts = _steps(steps, beta1, beta2)
    decay = _decay(beta1, beta2, eps)
    width = total // max(len(param), 1)
    blocks = parts(total, _NUMBERS)
    launch(
        "adam_update",
        "adam:update_parameter",
        blocks,
        _BLOCK,
        column,
        rate,
        lr,
        counts,
        decay,
        total,
        width,
    )
    increment_version(param)


def _steps(
    steps: int | Tensor | None,
    beta1: float,
    beta2: float,
) -> dict[str, Any]:
    """The step count of every row, int32 or int64; with neither, the corrections of all rows."""
    counts = dict.fromkeys(("of_row", "of_row_64")) | dict.fromkeys(
        ("ln_beta1", "ln_beta2", "first", "second"), 0.0
    )
    if not isinstance(steps, Tensor):
        first, second = corrections(math.inf if steps is None else float(steps), beta1, beta2)
        return counts | {"first": first, "second": second}
    name = "of_row_64" if steps.dtype == torch.int64 else "of_row"
    return counts | {name: steps.contiguous(), "ln_beta1": _ln(beta1), "ln_beta2": _ln(beta2)}


def _ln(beta: float) -> float:
    return math.log(beta) if beta > 0 else -math.inf


def _decay(beta1: float, beta2: float, eps: float) -> dict[str, float]:
    return {
        "beta1": beta1,
        "one_minus_beta1": 1 - beta1,
        "beta2": beta2,
        "one_minus_beta2": 1 - beta2,
        "eps": eps,
    }
