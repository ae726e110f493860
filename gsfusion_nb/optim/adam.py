"""Adam on a map that grows while it is optimised."""

import math
from typing import Any, NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from ..backends import op
from ..checks import check_number
from ..config import OptimConfig
from ..gaussians import GaussianModel
from ..observing import observed
from ..operands import INTEGERS, check_gaussians, check_operand
from ..types import GaussianParams
from .row_rates import at_row_rates


def check_adam(
    param: Any,
    gradient: Any,
    exp_avg: Any,
    exp_avg_sq: Any,
    steps: Any,
    *,
    lr: Any,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """Raise ``ValueError`` for arguments that ``adam_update`` refuses."""
    check_operand("param", param, ("N", *("W",) * (getattr(param, "ndim", 1) - 1)))
    for name, value in {"gradient": gradient, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}.items():
        check_operand(name, value, tuple(param.shape), dtypes=(param.dtype,), device=param.device)
    for name, value in {"param": param, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}.items():
        _check_writable(name, value)
    _check_steps(steps, param)
    if not isinstance(lr, Tensor):
        check_number("lr", lr)
    else:
        row = tuple(param.shape[1:])
        check_operand("lr", lr, tuple(lr.shape), device=None if lr.device.type == "cpu" else param.device)
        if lr.ndim > len(row) or any(a not in (1, b) for a, b in zip(lr.shape[::-1], row[::-1], strict=False)):
            raise ValueError(f"lr must be one number or fit a row {list(row)}, got {list(lr.shape)}")
    _check_decay(beta1, beta2, eps)


def _check_writable(name: str, value: Tensor) -> None:
    if not value.is_contiguous() and 0 in value.stride() and value.numel() > 1:
        raise ValueError(f"{name} is written to and must not be an expanded view, got strides {value.stride()}")


def _check_steps(steps: Any, param: Tensor) -> None:
    if isinstance(steps, Tensor):
        check_operand("steps", steps, (len(param),), dtypes=INTEGERS, device=param.device)
    elif steps is not None:
        check_number("steps", steps, 1)


def _check_decay(beta1: float, beta2: float, eps: float) -> None:
    check_number("beta1", beta1, 0.0, 1.0)
    check_number("beta2", beta2, 0.0, 1.0)
    check_number("eps", eps, 0.0)


@op("adam", check_adam)
def adam_update(
    param: Float[Tensor, "N *W"],
    gradient: Float[Tensor, "N *W"],
    exp_avg: Float[Tensor, "N *W"],
    exp_avg_sq: Float[Tensor, "N *W"],
    steps: int | Int[Tensor, " N"] | None,
    *,
    lr: float | Float[Tensor, "*W"],
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """One step of Adam, in place on ``param``, ``exp_avg`` and ``exp_avg_sq``.

        m <- b1 m + (1 - b1) g,   v <- b2 v + (1 - b2) g^2
        param <- param - lr (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)

    Args:
        param: Values to update. [N, ...]
        gradient: dL/dparam. [N, ...]
        exp_avg: m. [N, ...]
        exp_avg_sq: v. [N, ...]
        steps: t, including this step: one number for all rows, or one per row [N]. None: no bias correction.
        lr: Learning rate, in units of the parameter: one number, or one for each value of a row. [...]
        beta1: Decay of m.
        beta2: Decay of v.
        eps: Keeps the division finite where v = 0.

    Rows that no pixel sees have zero gradient, but their momentum still moves them, as in the released GSFusion.

    Source: Kingma & Ba 2015, algorithm 1.
    """
    m = beta1 * exp_avg + (1 - beta1) * gradient
    v = beta2 * exp_avg_sq + (1 - beta2) * gradient**2
    if isinstance(steps, Tensor):  # float64, because 1 - b2^t loses its digits in float32
        t = steps.double().reshape(-1, *[1] * (param.ndim - 1))
        m_hat, v_hat = m / (1 - beta1**t).to(m), v / (1 - beta2**t).to(v)
    else:
        t = math.inf if steps is None else steps
        m_hat, v_hat = m / (1 - beta1**t), v / (1 - beta2**t)
    param.copy_(param - lr * m_hat / (v_hat.sqrt() + eps))
    exp_avg.copy_(m)
    exp_avg_sq.copy_(v)


class ColumnRates(NamedTuple):
    """Learning rate of each column of a map, in units of the parameter."""

    xyz_W: float
    log_scale: float
    quat: float
    opacity_logit: float
    sh_dc: float
    """Of SH coefficient 0."""
    sh_rest: float
    """Of the other SH coefficients."""

    def by_column(self, sh: Float[Tensor, "N K 3"]) -> dict[str, float | Tensor]:
        """The same as ``adam_update`` takes it: one number, and for ``sh`` one for each coefficient. [K, 3]"""
        sh_rates = sh.new_full((sh.shape[1], 1), self.sh_rest)
        sh_rates[0] = self.sh_dc
        return {
            "xyz_W": self.xyz_W,
            "log_scale": self.log_scale,
            "quat": self.quat,
            "opacity_logit": self.opacity_logit,
            "sh": sh_rates.expand(-1, 3),
        }


def check_adam_map(
    params: Any,
    gradients: Any,
    exp_avg: Any,
    exp_avg_sq: Any,
    steps: Any,
    *,
    rates: Any,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """Raise ``ValueError`` for arguments that ``adam_update_map`` refuses."""
    check_gaussians(params)
    for name, rows in {"gradients": gradients, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}.items():
        if not isinstance(rows, GaussianParams):
            raise ValueError(f"{name} must be GaussianParams, got {type(rows).__name__}")
        try:
            check_gaussians(rows, like=params)
        except ValueError as e:
            raise ValueError(f"{name}.{e}") from None
    for name, rows in {"params": params, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}.items():
        for column, value in vars(rows).items():
            if not value.is_contiguous():
                _check_writable(f"{name}.{column}", value)
    _check_steps(steps, params.xyz_W)
    if not isinstance(rates, ColumnRates):
        raise ValueError(f"rates must be ColumnRates, got {type(rates).__name__}")
    for name, rate in zip(ColumnRates._fields, rates, strict=True):
        check_number(f"rates.{name}", rate)
    _check_decay(beta1, beta2, eps)


@op("adam", check_adam_map)
def adam_update_map(
    params: GaussianParams,
    gradients: GaussianParams,
    exp_avg: GaussianParams,
    exp_avg_sq: GaussianParams,
    steps: int | Int[Tensor, " N"] | None,
    *,
    rates: ColumnRates,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """``adam_update`` of every column of a map, each at its own learning rate.

    Args:
        params: Values to update, in place.
        gradients: dL/dparams.
        exp_avg: m of each value, updated in place.
        exp_avg_sq: v of each value, updated in place.
        steps: t, including this step: one number for all rows, or one per row [N]. None: no bias correction.
        rates: Learning rates.
        beta1: Decay of m.
        beta2: Decay of v.
        eps: Keeps the division finite where v = 0.

    Source: Kingma & Ba 2015, algorithm 1.
    """
    for name, lr in rates.by_column(params.sh).items():
        p, g, m, v = (getattr(rows, name) for rows in (params, gradients, exp_avg, exp_avg_sq))
        adam_update(p, g, m, v, steps, lr=lr, beta1=beta1, beta2=beta2, eps=eps)


@observed
def adam_step(model: GaussianModel, gradients: GaussianParams, config: OptimConfig) -> None:
    """Update every parameter of the map once, each group at its own constant learning rate.

    The bias correction multiplies a step by sqrt(1 - b2^t) / (1 - b1^t). ``config.adam_steps`` says what t is:

    - ``"per_row"``: the age of each Gaussian (textbook Adam). Its first step is one learning rate.
    - ``"none"``: no correction. Where the gradient stays the same, the first step of a new Gaussian is
      (1 - 0.9) / sqrt(1 - 0.999) = 3.16 learning rates and its tenth 6.5.
    - ``"shared"``: the number of steps of the whole map, as in the released GSFusion. Every Gaussian of the map, new or
      old, then takes the step of ``"none"`` times the same factor: 0.15 at step 10, 0.44 at 210, 0.93 at 2,000. In a
      short run all Gaussians learn more slowly; at the 16,000 steps of a Replica sequence there is no difference left.

    Where the map has factors of learning rates (``model.rates``), each row takes its own part of the step.
    """
    t = model.step_count + 1
    steps: int | Tensor | None = {"none": None, "shared": t}.get(config.adam_steps)
    if config.adam_steps == "per_row":
        steps = t - model.birth_step
    rates = ColumnRates(
        xyz_W=config.lr_xyz,
        log_scale=config.lr_log_scale,
        quat=config.lr_quat,
        opacity_logit=config.lr_opacity_logit,
        sh_dc=config.lr_sh_dc,
        sh_rest=config.lr_sh_rest,
    )
    moments, decay = (model.exp_avg, model.exp_avg_sq), (config.beta1, config.beta2)
    with at_row_rates(model.params, model.rates):
        adam_update_map(
            model.params, gradients, *moments, steps, rates=rates, beta1=decay[0], beta2=decay[1], eps=config.eps
        )
    model.step_count = t
