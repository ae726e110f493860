"""The nearest points of each point by all distances: ``neighbours.cu``. The host does not wait."""

import torch
from torch import Tensor

from gsfusion_nb.backends import load

from ..runtime.arguments import packed, parts
from ..runtime.cuda.launch import device_of, launch

_BLOCK = 128
_MOST = 8
"""As in ``neighbours.cu``."""


def k_nearest(xyz_W: Tensor, others_W: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """See ``gsfusion_nb.seeding.points.k_nearest``; more than 8 neighbours are left to the
    reference."""
    device = device_of("k_nearest", xyz_W)
    M = len(xyz_W)
    N = len(others_W)
    if xyz_W.dtype != torch.float32 or k > _MOST:
        return load("k_nearest", "reference")(xyz_W, others_W, k)
    distance, row = (
        torch.empty(M, k, dtype=kind, device=device) for kind in (torch.float32, torch.int64)
    )
    points = packed(xyz_W), packed(others_W)
    launch(
        "k_nearest", "neighbours:nearest", parts(M, _BLOCK), _BLOCK, *points, distance, row, M, N, k
    )
    return distance, row
