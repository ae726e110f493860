"""Nearest points: several pieces of others, fewer than asked for, and none. Cases of ``k_nearest``."""

from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.seeding.points import k_nearest

from ..runtime.cases import Case


def cases() -> Iterator[Case]:
    """One for each pair of numbers of points."""
    for M, N, k in ((300, 1000, 1), (70, 1000, 4), (70, 300, 9), (7, 2, 4), (0, 5, 2), (5, 0, 2)):
        yield _case(M, N, k)


def _case(M: int, N: int, k: int) -> Case:
    def run(device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
        g = torch.Generator().manual_seed(0)
        xyz, others = (torch.randn(n, 3, generator=g).to(device, dtype) + 20 for n in (M, N))
        distance, row = k_nearest(xyz, others, k)
        exists = row < N
        return {"distance": distance.where(exists, 0.0), "exists": exists, "row": row}

    return Case(name=f"{k} of {N} to {M}", operations=("k_nearest",), run=run)
