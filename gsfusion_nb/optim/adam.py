"""Adam as an operation: one step of a parameter, or of every column of a map."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from ..backends import op
from ..checks import check_number
from ..errors import ArgumentError
from ..geometry.operands import INTEGERS, check_gaussians, check_operand
from ..types import GaussianParams


def check_adam(
    param: Any,
    gradient: Any,
    exp_avg: Any,
    exp_avg_sq: Any,
    steps: Any,
    *,
    lr: Any,
    **decay: float,
) -> None:
    """Raise ``ValueError`` for arguments that ``adam_update`` refuses."""
    check_operand(
        "param",
        param,
        ("N", *("W",) * (getattr(param, "ndim", 1) - 1)),
    )
    for name, value in {"gradient": gradient, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}.items():
        check_operand(
            name,
            value,
            tuple(param.shape),
            dtypes=(param.dtype,),
            device=param.device,
        )
    if isinstance(lr, Tensor):
        check_operand(
            "lr",
            lr,
            tuple(param.shape[1:]),
            device=None if lr.device.type == "cpu" else param.device,
        )
    else:
        check_number("lr", lr)
    _check_steps_and_decay(steps, param, decay)


def _check_steps_and_decay(steps: Any, param: Tensor, decay: Mapping[str, float]) -> None:
    if isinstance(steps, Tensor):
        check_operand("steps", steps, (len(param),), dtypes=INTEGERS, device=param.device)
    elif steps is not None:
        check_number("steps", steps, 1)
    check_number("eps", decay["eps"], 0.0)
    for name in ("beta1", "beta2"):
        check_number(name, decay[name], 0.0, 1.0)


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
        steps: t, including this step: one number for all rows, or one per row [N]. None: no bias
            correction.
        lr: Learning rate, in units of the parameter: one number, or one for each value of a row.
            [...]
        beta1: Decay of m.
        beta2: Decay of v.
        eps: Keeps the division finite where v = 0.

    Rows that no pixel sees have zero gradient, but their momentum still moves them, as in the
    released GSFusion. Those that the view cannot show are left out (``MapPart``) and catch up when
    they are seen (``take_missed_steps``).

    Source: Kingma & Ba 2015, algorithm 1.
    """
    m = beta1 * exp_avg + (1 - beta1) * gradient
    v = beta2 * exp_avg_sq + (1 - beta2) * gradient**2
    m_hat = m / _bias(beta1, steps, m)
    v_hat = v / _bias(beta2, steps, v)
    param.copy_(param - lr * m_hat / (v_hat.sqrt() + eps))
    exp_avg.copy_(m)
    exp_avg_sq.copy_(v)


def _bias(beta: float, steps: int | Tensor | None, moment: Tensor) -> float | Tensor:
    """1 - beta^t: the share of its weights that a moment has which began at 0; 1 without a
    correction."""
    if not isinstance(steps, Tensor):
        return 1.0 if steps is None else 1 - beta**steps
    # float64: 1 - b2^t would lose its digits in float32
    t = steps.double().reshape(-1, *[1] * (moment.ndim - 1))
    return (1 - beta**t).to(moment)


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
        """The same as ``adam_update`` takes it: one number, and for ``sh`` one for each
        coefficient. [K, 3]"""
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
    **decay: float,
) -> None:
    """Raise ``ValueError`` for arguments that ``adam_update_map`` refuses."""
    check_gaussians(params)
    for name, rows in {
        "gradients": gradients,
        "exp_avg": exp_avg,
        "exp_avg_sq": exp_avg_sq,
    }.items():
        try:
            check_gaussians(rows, like=params)
        except ValueError as e:
            raise ArgumentError(f"{name}.{e}") from None
    if not isinstance(rates, ColumnRates):
        raise ArgumentError(f"rates must be ColumnRates, got {type(rates).__name__}")
    for name, rate in rates._asdict().items():
        check_number(f"rates.{name}", rate)
    _check_steps_and_decay(steps, params.xyz_W, decay)


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
        steps: t, including this step: one number for all rows, or one per row [N]. None: no bias
            correction.
        rates: Learning rates.
        beta1: Decay of m.
        beta2: Decay of v.
        eps: Keeps the division finite where v = 0.

    Source: Kingma & Ba 2015, algorithm 1.
    """
    for name, lr in rates.by_column(params.sh).items():
        p, g, m, v = (getattr(rows, name) for rows in (params, gradients, exp_avg, exp_avg_sq))
        adam_update(
            p,
            g,
            m,
            v,
            steps,
            lr=lr,
            beta1=beta1,
            beta2=beta2,
            eps=eps,
        )
