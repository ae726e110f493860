"""Between voxel centres: a cell has eight of them as corners, and trilinear weights of these."""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .voxels import corners


def cell_corners(
    volume: Any, xyz_W: Float[Tensor, "N 3"]
) -> tuple[Int[Tensor, "N 8"], Float[Tensor, "N 3"]]:
    """The eight voxels whose centres surround each point, and where the point lies between them.

    Args:
        volume: The ``TsdfVolume``.
        xyz_W: Points, world frame, metres. [N, 3]

    Returns:
        Positions in the flattened pool, -1 if not allocated, corner x + 2 y + 4 z [N, 8]; fractions
        in 0..1 [N, 3].
    """
    p = xyz_W / volume.config.voxel_size_m - 0.5
    lowest = p.floor()
    surrounding = lowest.long()[:, None] + corners(volume.device)
    return volume.find_voxels(surrounding), p - lowest


def corner_weights(f: Float[Tensor, "N 3"]) -> Float[Tensor, "N 8"]:
    """Trilinear weights of the corners of a cell, at fractions ``f`` along its edges: products of f
    or 1 - f."""
    return torch.where(
        corners(f.device) == 1,
        f[:, None],
        1.0 - f[:, None],
    ).prod(2)


def corner_gradients(f: Float[Tensor, "N 3"]) -> Float[Tensor, "N 8 3"]:
    """Derivatives of ``corner_weights`` along the three axes: plus or minus the product over the
    other two axes."""
    upper = corners(f.device) == 1
    along = torch.where(upper, f[:, None], 1.0 - f[:, None])
    others = along[..., [[1, 2], [0, 2], [0, 1]]].prod(3)
    return torch.where(upper, others, -others)
