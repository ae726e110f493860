"""One step of Adam on a map that grows while it is optimised."""

import contextlib
import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from ..backends import observed
from ..config import OptimConfig
from ..errors import ArgumentError
from ..gaussians import GaussianModel
from ..large_maps import MapPart
from ..types import GaussianParams
from .adam import ColumnRates, adam_update_map

UpdateFunction = Callable[..., None]
"""``update(param, gradient, m, v, steps, *, lr)``: an optimiser that is given to a mapper in place
of Adam.

It changes one column of the map in place: ``param`` [N, ...], and ``m`` and ``v`` of the same
shape. These two are its memory: they begin at zero, follow each row when rows are added and
removed, and are saved in checkpoints. ``steps`` [N] counts the steps of each row, this one
included. ``lr`` is the learning rate of the settings, a number or a tensor that fits a row. A
column whose learning rate is 0 is left alone. A function with an argument ``column`` is told the
name of the column: "xyz_W", "log_scale", "quat", "opacity_logit" or "sh"."""


class AdamSettings(NamedTuple):
    """What Adam is told of a map; ``OptimConfig`` has it among other settings."""

    rates: ColumnRates
    beta1: float
    beta2: float
    eps: float
    steps: Literal["none", "shared", "per_row"]
    """What t of the bias correction counts, as in ``OptimConfig.adam_steps``."""

    @staticmethod
    def of(config: "OptimConfig | AdamSettings") -> "AdamSettings":
        """Those of a group of settings."""
        if isinstance(config, AdamSettings):
            return config
        rates = ColumnRates(
            xyz_W=config.lr_xyz,
            log_scale=config.lr_log_scale,
            quat=config.lr_quat,
            opacity_logit=config.lr_opacity_logit,
            sh_dc=config.lr_sh_dc,
            sh_rest=config.lr_sh_rest,
        )
        return AdamSettings(
            rates=rates,
            beta1=config.beta1,
            beta2=config.beta2,
            eps=config.eps,
            steps=config.adam_steps,
        )


@observed
def adam_step(
    model: GaussianModel | MapPart,
    gradients: GaussianParams,
    config: OptimConfig | AdamSettings,
    update: UpdateFunction | None = None,
) -> None:
    """Update every parameter of the map once, each group at its own constant learning rate.

    The bias correction multiplies a step by sqrt(1 - b2^t) / (1 - b1^t). ``config.adam_steps`` says
    what t is:

    - ``"per_row"``: the age of each Gaussian (textbook Adam). Its first step is one learning rate.
    - ``"none"``: no correction. Where the gradient stays the same, the first step of a new Gaussian
      is (1 - 0.9) / sqrt(1 - 0.999) = 3.16 learning rates and its tenth 6.5.
    - ``"shared"``: the number of steps of the whole map, as in the released GSFusion. Every
      Gaussian of the map, new or old, then takes the step of ``"none"`` times the same factor: 0.15
      at step 10, 0.44 at 210, 0.93 at 2,000. In a short run all Gaussians learn more slowly; at the
      16,000 steps of a Replica sequence there is no difference left.

    Where the map has factors of learning rates (``model.rates``), each row takes its own part of
    the step.

    Args:
        model: The map, or a part of it, changed in place.
        gradients: dL/d of its parameters.
        config: Learning rates and decays.
        update: Takes the step of each column instead of ``adam_update``.

    Raises:
        ValueError: ``update`` made a parameter NaN or infinite that was finite.
    """
    adam = AdamSettings.of(config)
    t = model.clock.count + 1
    steps: int | Tensor | None = {"none": None, "shared": t}.get(adam.steps)
    if adam.steps == "per_row":
        steps = t - model.clock.birth
    m = model.moments.exp_avg
    v = model.moments.exp_avg_sq
    with at_row_rates(model.params, model.rates):
        if update is None:
            decay = {"beta1": adam.beta1, "beta2": adam.beta2, "eps": adam.eps}
            adam_update_map(model.params, gradients, m, v, steps, rates=adam.rates, **decay)
        else:
            ages = t - model.clock.birth
            for name, lr in adam.rates.by_column(model.params.sh).items():
                if name != "sh" and lr == 0:
                    continue
                p, g, m_, v_ = (getattr(rows, name) for rows in (model.params, gradients, m, v))
                take_step(update, name, p, g, m_, v_, ages, lr)
    model.clock.step()


def take_step(
    update: UpdateFunction,
    name: str,
    param: Tensor,
    gradient: Tensor,
    m: Tensor,
    v: Tensor,
    ages: Tensor,
    lr: Any,
) -> None:
    """One step of an optimiser from outside on the column ``name``; arguments as for
    ``UpdateFunction``.

    Raises:
        ValueError: a value is no longer finite that was before.
    """
    finite = param.isfinite()
    update(param, gradient, m, v, ages, lr=lr, **column_argument(update, name))
    if n_lost := int((finite & ~param.isfinite()).sum()):
        raise ArgumentError(
            f"the optimiser made {n_lost} values of {name} NaN or infinite; try smaller learning "
            "rates"
        )


def column_argument(update: UpdateFunction, column: str) -> dict[str, str]:
    """The argument ``column`` of an optimiser from outside, if it has one."""
    try:
        takes_column = "column" in inspect.signature(update).parameters
    except (TypeError, ValueError):  # something in C
        takes_column = False
    return {"column": column} if takes_column else {}


@contextlib.contextmanager
def at_row_rates(
    params: GaussianParams, factors: Mapping[str, Float[Tensor, " N"]]
) -> Iterator[None]:
    """Context in which one step of Adam is taken, which then moves each row by ``factors`` times as
    far.

    The step of Adam is its learning rate times a direction that does not depend on it, so a factor
    of the step is the same factor of the learning rate. With factor 0 the row keeps its values bit
    for bit, with 1 it takes the step bit for bit. Adam's moments change as usual, also those of
    frozen rows.

    Args:
        params: What the step changes in place.
        factors: Parameter -> factor of each row, at least 0; a parameter that is missing takes its
            whole step.
    """
    old_values = {name: getattr(params, name).clone() for name in factors}
    yield
    for name, start in old_values.items():
        value = getattr(params, name)
        factor = factors[name].reshape(-1, *[1] * (value.ndim - 1)).to(value)
        value.copy_(
            torch.where(
                factor == 0,
                start,
                torch.lerp(start, value, factor),
            )
        )
