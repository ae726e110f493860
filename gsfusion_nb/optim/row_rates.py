"""A learning rate of its own for every Gaussian."""

import contextlib
from collections.abc import Iterator, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from ..types import GaussianParams


@contextlib.contextmanager
def at_row_rates(params: GaussianParams, factors: Mapping[str, Float[Tensor, " N"]]) -> Iterator[None]:
    """Context in which one step of Adam is taken, which then moves each row by ``factors`` times as far.

    The step of Adam is its learning rate times a direction that does not depend on it, so a factor of the step is the
    same factor of the learning rate. With factor 0 the row keeps its values bit for bit, with 1 it takes the step bit
    for bit. Adam's moments change as usual, also those of frozen rows.

    Args:
        params: What the step changes in place.
        factors: Parameter -> factor of each row, at least 0; a parameter that is missing takes its whole step.
    """
    before = {name: getattr(params, name).clone() for name in factors}
    yield
    for name, start in before.items():
        value = getattr(params, name)
        factor = factors[name].reshape(-1, *[1] * (value.ndim - 1)).to(value)
        value.copy_(torch.where(factor == 0, start, torch.lerp(start, value, factor)))
