"""Adam on a map that grows while it is optimised."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..backends import op
from ..config import OptimConfig
from ..gaussians import GaussianModel
from ..types import GaussianParams


@op
def adam_update(
    param: Float[Tensor, "N *W"],
    gradient: Float[Tensor, "N *W"],
    exp_avg: Float[Tensor, "N *W"],
    exp_avg_sq: Float[Tensor, "N *W"],
    steps: int | Int[Tensor, " N"],
    *,
    lr: float,
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
        steps: t, counting this step: one number for all rows, or one per row. [N]
        lr: Step size, in units of the parameter.
        beta1: Decay of m.
        beta2: Decay of v.
        eps: Keeps the division finite where v = 0.

    Rows that no pixel sees have zero gradient and still drift by their momentum, as in the released GSFusion.
    """
    exp_avg.mul_(beta1).add_(gradient, alpha=1 - beta1)
    exp_avg_sq.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
    if isinstance(steps, int):
        denominator = exp_avg_sq.sqrt().mul_(1 / math.sqrt(1 - beta2**steps)).add_(eps)
        param.addcdiv_(exp_avg, denominator, value=-lr / (1 - beta1**steps))
    else:
        t = steps.to(param.dtype).reshape(-1, *[1] * (param.ndim - 1))
        denominator = exp_avg_sq.sqrt().mul_(torch.rsqrt(1 - beta2**t)).add_(eps)
        param.addcdiv_(exp_avg / (1 - beta1**t), denominator, value=-lr)


def adam_step(model: GaussianModel, gradients: GaussianParams, config: OptimConfig) -> None:
    """Update every parameter of the map once, each group at its own constant learning rate.

    With ``adam_steps="shared"`` the bias correction uses the map's step count, so a newborn Gaussian, whose moments are
    zero, first moves (1 - 0.9) / sqrt(1 - 0.999) = 3.16 times the learning rate; "per_row" counts from its birth.
    """
    model.step_count += 1
    steps: int | Tensor = model.step_count
    if config.adam_steps == "per_row":
        steps = model.step_count - model.birth_step
    groups = {
        "xyz_W": config.lr_xyz,
        "log_scale": config.lr_log_scale,
        "quat": config.lr_quat,
        "opacity_logit": config.lr_opacity_logit,
    }
    params, m, v = model.params, model.exp_avg, model.exp_avg_sq
    moments = {"beta1": config.beta1, "beta2": config.beta2, "eps": config.eps}
    for name, lr in groups.items():
        p, g, mm, vv = (getattr(rows, name) for rows in (params, gradients, m, v))
        adam_update(p, g, mm, vv, steps, lr=lr, **moments)
    for part, lr in ((slice(0, 1), config.lr_sh_dc), (slice(1, None), config.lr_sh_rest)):
        p, g, mm, vv = (rows.sh[:, part] for rows in (params, gradients, m, v))
        if p.shape[1]:
            adam_update(p, g, mm, vv, steps, lr=lr, **moments)
