"""Which voxels of any size hold a point: a sorted list of voxel keys."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_BITS = 21
"""Bits of a voxel coordinate in a key; one that needs more is cut to the last of these."""


def voxel_keys(xyz_W: Float[Tensor, "N 3"], voxel_size_m: float) -> Int[Tensor, " N"]:
    """One whole number for the voxel floor(xyz / voxel size) that contains each point. Two voxels have the same number
    only if they are 2^21 voxels apart."""
    x, y, z = ((xyz_W / voxel_size_m).floor().long() & ((1 << _BITS) - 1)).unbind(dim=1)
    return (x << 2 * _BITS) | (y << _BITS) | z


class VoxelHash:
    """The set of voxels that contain at least one of some points.

    Args:
        xyz_W: The points, metres.
        voxel_size_m: Edge length of a voxel, metres.
    """

    def __init__(self, xyz_W: Float[Tensor, "N 3"], voxel_size_m: float):
        self.voxel_size_m = voxel_size_m
        self._keys = voxel_keys(xyz_W, voxel_size_m).unique()

    def __len__(self) -> int:
        return len(self._keys)

    def contains(self, xyz_W: Float[Tensor, "M 3"]) -> Bool[Tensor, " M"]:
        """Whether the voxel of each point is in the set."""
        keys = voxel_keys(xyz_W, self.voxel_size_m)
        if not len(self._keys):
            return torch.zeros_like(keys, dtype=torch.bool)
        at = torch.searchsorted(self._keys, keys).clamp_max(len(self._keys) - 1)
        return self._keys[at] == keys


def first_in_voxel(xyz_W: Float[Tensor, "N 3"], voxel_size_m: float) -> Bool[Tensor, " N"]:
    """True for the first point of each voxel."""
    keys, group = voxel_keys(xyz_W, voxel_size_m).unique(return_inverse=True)
    row = torch.arange(len(xyz_W), device=xyz_W.device)
    first = torch.full_like(keys, len(xyz_W)).scatter_reduce_(0, group, row, "amin")
    return first[group] == row
