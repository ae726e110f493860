"""Steps of Adam with zero gradient, which rows missed while no view showed them, taken at once."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..backends import op
from ..config import OptimConfig
from ..gaussians import GaussianModel
from ..large_maps import MapPart
from ..types import GaussianParams
from .adam import ColumnRates
from .map_step import AdamSettings

_NOTHING_LEFT = 8e-10
"""With zero gradient a row has stopped when its step is this share of the first: after 200 steps at
the usual decays, since (0.9 / sqrt(0.999))^200 is 8e-10."""


def take_missed_steps(model: GaussianModel | MapPart, config: OptimConfig | AdamSettings) -> None:
    """Move the rows by the steps of Adam that they missed while no view showed them: steps with
    zero gradient.

    In each of them  m <- b1 m,  v <- b2 v,  so k steps together are a geometric series, with  r =
    b1 / sqrt(b2):

        param <- param - lr m / (sqrt(v) + eps) sum_{j=1..k} c_j r^j,   m <- b1^k m,   v <- b2^k v

    c_j is the bias correction  sqrt(1 - b2^t) / (1 - b1^t)  of the j-th missed step, or 1 without
    one. This is ``adam_step`` on the whole map but for rounding and for eps, which is 1e-15 beside
    sqrt(v).

    Args:
        model: The map, or a part of it, changed in place.
        config: Learning rates and decays.
    """
    clock = model.clock
    n_missed = clock.steps_missed
    if not bool(n_missed.any()):
        return
    adam = AdamSettings.of(config)
    start = {"none": None, "shared": clock.last, "per_row": clock.age_at_last}[adam.steps]
    steps = MissedSteps(n_missed, start, adam.beta1, adam.beta2, adam.eps)
    m = model.moments.exp_avg
    v = model.moments.exp_avg_sq
    if model.rates:
        for name, lr in adam.rates.by_column(model.params.sh).items():
            column, m_, v_ = (getattr(rows, name) for rows in (model.params, m, v))
            steps.take(column, m_, v_, lr, model.rates.get(name))
    else:
        decays = (steps.distance, steps.decay1, steps.decay2)
        missed_steps_map(model.params, m, v, *decays, rates=adam.rates, eps=adam.eps)
    clock.catch_up()


@op("missed_steps")
def missed_steps_map(
    params: GaussianParams,
    exp_avg: GaussianParams,
    exp_avg_sq: GaussianParams,
    distance: Float[Tensor, " R"],
    decay1: Float[Tensor, " R"],
    decay2: Float[Tensor, " R"],
    *,
    rates: ColumnRates,
    eps: float,
) -> None:
    """The steps that rows missed, of every column of a map:

        param <- param - lr distance m / (sqrt(v) + eps),   m <- decay1 m,   v <- decay2 v

    Args:
        params: Values to update, in place.
        exp_avg: m of each value, updated in place.
        exp_avg_sq: v of each value, updated in place.
        distance: sum_j c_j r^j of each row; 0 for a row that missed nothing. [R]
        decay1, decay2: b1^k and b2^k of each row; 1 for a row that missed nothing. [R]
        rates: Learning rates.
        eps: Keeps the division finite where v = 0.
    """
    for name, lr in rates.by_column(params.sh).items():
        column, m, v = (getattr(rows, name) for rows in (params, exp_avg, exp_avg_sq))
        _take_at_once(column, m, v, lr, (distance, decay1, decay2), eps)


def _take_at_once(
    column: Tensor,
    m: Tensor,
    v: Tensor,
    lr: float | Tensor,
    of_rows: tuple[Tensor, Tensor, Tensor],
    eps: float,
) -> None:
    distances, decay1, decay2 = (x.to(m).view(-1, *[1] * (m.ndim - 1)) for x in of_rows)
    column -= lr * distances * m / (v.sqrt() + eps)
    m *= decay1
    v *= decay2


class MissedSteps:
    """The steps of ``take_missed_steps``, for one column of the map after another; a row with k = 0
    stays as it is.

    Args:
        missed: k of each row. [R]
        start: t of the step before the first missed one; None: without bias correction. [R]
        beta1, beta2, eps: As for ``adam_update``.
    """

    def __init__(
        self,
        missed: Int[Tensor, " R"],
        start: Int[Tensor, " R"] | None,
        beta1: float,
        beta2: float,
        eps: float,
    ):
        self.eps = eps
        ratio = beta1 / math.sqrt(beta2)
        self.decay1, self.decay2 = (beta ** missed.double() for beta in (beta1, beta2))
        if start is None:
            self.distance = ratio * (1 - ratio ** missed.double()) / (1 - ratio)
        else:  # rows that were seen together share their sum
            enough = math.ceil(math.log(_NOTHING_LEFT) / math.log(ratio)) if ratio else 1
            k = missed.clamp_max(enough)
            pairs, which = torch.unique(start.long() * (enough + 1) + k, return_inverse=True)
            first = pairs[:, None] // (enough + 1)
            last = pairs[:, None] % (enough + 1)
            j = torch.arange(
                1,
                int(k.max()) + 1,
                device=k.device,
            )
            t = (first + j).double()
            terms = (1 - beta2**t).sqrt() / (1 - beta1**t) * ratio**j
            self.distance = (terms * (j <= last)).sum(1)[which]

    def take(
        self,
        column: Tensor,
        m: Tensor,
        v: Tensor,
        lr: float | Tensor,
        factor: Tensor | None,
    ) -> None:
        """Change a column and its moments in place; ``factor`` of the learning rate is one for each
        row."""
        distance = self.distance if factor is None else self.distance * factor
        _take_at_once(column, m, v, lr, (distance, self.decay1, self.decay2), self.eps)
