"""Random draws without replacement, from the generator that a rule is given."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def draw(n: int, count: int, generator: torch.Generator) -> Int[Tensor, " K"]:
    """``count`` of the numbers 0 .. n - 1, all equally likely, in increasing order; all if there are fewer."""
    order = torch.randperm(n, generator=generator, device=generator.device)
    return order[: max(count, 0)].sort().values


def draw_weighted(weight: Float[Tensor, " N"], count: int, generator: torch.Generator) -> Int[Tensor, " K"]:
    """``count`` of the rows, drawn one after another with probabilities in proportion to the weights of those that are
    left, in increasing order; a row of weight 0 is never drawn, so there may be fewer.

    The ``count`` smallest of E_i / w_i with E_i exponentially distributed have this distribution (Efraimidis and
    Spirakis 2006).
    """
    uniform = torch.rand(len(weight), generator=generator, device=generator.device).to(weight.device)
    key = -torch.log1p(-uniform) / weight
    key = torch.where(weight > 0, key, torch.inf)
    count = min(max(count, 0), int((weight > 0).sum()))
    return key.argsort(stable=True)[:count].sort().values
