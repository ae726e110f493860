"""Adam on a map that grows while it is optimised."""

import math
from typing import Any

from jaxtyping import Float, Int
from torch import Tensor

from ..backends import op
from ..checks import check_number
from ..config import OptimConfig
from ..gaussians import GaussianModel
from ..operands import INTEGERS, check_gaussians, check_operand
from ..types import GaussianParams


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
        if not value.is_contiguous() and 0 in value.stride() and value.numel() > 1:
            raise ValueError(f"{name} is written to and must not be an expanded view, got strides {value.stride()}")
    if isinstance(steps, Tensor):
        check_operand("steps", steps, (len(param),), dtypes=INTEGERS, device=param.device)
    elif steps is not None:
        check_number("steps", steps, 1)
    if not isinstance(lr, Tensor):
        check_number("lr", lr)
    else:
        row = tuple(param.shape[1:])
        check_operand("lr", lr, tuple(lr.shape), device=None if lr.device.type == "cpu" else param.device)
        if lr.ndim > len(row) or any(a not in (1, b) for a, b in zip(lr.shape[::-1], row[::-1], strict=False)):
            raise ValueError(f"lr must be one number or fit a row {list(row)}, got {list(lr.shape)}")
    for name, beta in {"beta1": beta1, "beta2": beta2}.items():
        check_number(name, beta, 0.0, 1.0)
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


def adam_step(model: GaussianModel, gradients: GaussianParams, config: OptimConfig) -> None:
    """Update every parameter of the map once, each group at its own constant learning rate.

    The bias correction multiplies a step by sqrt(1 - b2^t) / (1 - b1^t). ``config.adam_steps`` says what t is:

    - ``"per_row"``: the age of each Gaussian (textbook Adam). Its first step is one learning rate.
    - ``"none"``: no correction. Where the gradient stays the same, the first step of a new Gaussian is
      (1 - 0.9) / sqrt(1 - 0.999) = 3.16 learning rates and its tenth 6.5.
    - ``"shared"``: the number of steps of the whole map, as in the released GSFusion. Every Gaussian of the map, new or
      old, then takes the step of ``"none"`` times the same factor: 0.15 at step 10, 0.44 at 210, 0.93 at 2,000. In a
      short run all Gaussians learn more slowly; at the 16,000 steps of a Replica sequence there is no difference left.
    """
    check_gaussians(gradients, like=model.params)
    model.step_count += 1
    steps: int | Tensor | None = {"none": None, "shared": model.step_count}.get(config.adam_steps)
    if config.adam_steps == "per_row":
        steps = model.step_count - model.birth_step
    sh_rates = model.params.sh.new_full((model.params.sh.shape[1], 1), config.lr_sh_rest)
    sh_rates[0] = config.lr_sh_dc
    rates: dict[str, float | Tensor] = {
        "xyz_W": config.lr_xyz,
        "log_scale": config.lr_log_scale,
        "quat": config.lr_quat,
        "opacity_logit": config.lr_opacity_logit,
        "sh": sh_rates.expand(-1, 3),
    }
    params, m, v = model.params, model.exp_avg, model.exp_avg_sq
    for name, lr in rates.items():
        p, g, mm, vv = (getattr(rows, name) for rows in (params, gradients, m, v))
        adam_update(p, g, mm, vv, steps, lr=lr, beta1=config.beta1, beta2=config.beta2, eps=config.eps)
