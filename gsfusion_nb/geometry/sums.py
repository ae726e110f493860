"""Sums whose last digit does not depend on the number of threads."""

import torch
from jaxtyping import Float
from torch import Tensor


def sum_rows(x: Float[Tensor, "N *W"]) -> Float[Tensor, "*W"]:
    """Sum over the first axis, always in the same order.

    torch adds up a long tensor in as many parts as there are threads, and rounds differently for each number of them.
    numpy uses one thread.

    Differentiable: no.
    """
    return x.sum(0) if x.device.type != "cpu" else torch.as_tensor(x.detach().numpy().sum(axis=0), dtype=x.dtype)
