"""Nearest points: several pieces of others, fewer than asked for, and none. Cases of
``k_nearest``."""

from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor

from gsfusion_nb.seeding.points import k_nearest

from . import Case


def cases() -> Iterator[Case]:
    """One for each pair of numbers of points."""
    for M, N, k in ((300, 1000, 1), (70, 1000, 4), (70, 300, 9), (7, 2, 4), (0, 5, 2), (5, 0, 2)):
        yield Case(
            name=f"{k} of {N} to {M}",
            operations=("k_nearest",),
            run=partial(_run, M, N, k),
        )


def _run(
    M: int,
    N: int,
    k: int,
    device: torch.device,
    dtype: torch.dtype,
) -> dict[str, Tensor]:
    xyz, others = (
        torch.randn(n, 3, generator=torch.Generator().manual_seed(n)).to(device, dtype) + 20
        for n in (M, N)
    )
    distance, row = k_nearest(xyz, others, k)
    return {"distance": distance.where(row < N, 0.0), "exists": row < N, "row": row}
