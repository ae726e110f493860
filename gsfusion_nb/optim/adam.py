"""Adam on a map that grows while it is optimised."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..backends import op
from ..config import OptimConfig
from ..gaussians import GaussianModel
from ..types import GaussianParams


@op("adam")
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
    """One step of Adam (Kingma & Ba 2015, algorithm 1), in place on ``param``, ``exp_avg`` and ``exp_avg_sq``.

        m <- b1 m + (1 - b1) g,   v <- b2 v + (1 - b2) g^2
        param <- param - lr (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)

    Args:
        param: Values to update. [N, ...]
        gradient: dL/dparam. [N, ...]
        exp_avg: m. [N, ...]
        exp_avg_sq: v. [N, ...]
        steps: t, counting this step: one number for all rows, or one per row [N]; None is t = infinity, no correction.
        lr: Step size, in units of the parameter; one for all values of a row, or one for each. [...]
        beta1: Decay of m.
        beta2: Decay of v.
        eps: Keeps the division finite where v = 0.

    Rows that no pixel sees have zero gradient and still drift by their momentum, as in the released GSFusion.
    """
    exp_avg.mul_(beta1).add_(gradient, alpha=1 - beta1)
    exp_avg_sq.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
    if steps is None:
        correction_1, correction_2 = 1.0, 1.0
    elif isinstance(steps, int):
        correction_1, correction_2 = 1 - beta1**steps, math.sqrt(1 - beta2**steps)
    else:
        t = steps.double().reshape(-1, *[1] * (param.ndim - 1))  # 1 - b2^t loses its digits in float32
        correction_1, correction_2 = (1 - beta1**t).to(param), (1 - beta2**t).sqrt().to(param)
    step = exp_avg_sq.sqrt().div_(correction_2).add_(eps)
    torch.div(exp_avg, step, out=step)
    param.sub_(step.mul_(lr / correction_1))


def adam_step(model: GaussianModel, gradients: GaussianParams, config: OptimConfig) -> None:
    """Update every parameter of the map once, each group at its own constant learning rate.

    Adam's bias correction shrinks the first steps after the moments were zero. It was made for parameters that all
    start together; with ``adam_steps = "none"`` a newborn Gaussian first moves (1 - 0.9) / sqrt(1 - 0.999) = 3.16
    learning rates, and 6.5 at its tenth step. The released GSFusion corrects by the step count of the whole map
    ("shared"), which comes to the same for all but the Gaussians of the first frames.
    """
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
