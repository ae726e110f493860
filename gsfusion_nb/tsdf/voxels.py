"""Where voxels and blocks lie: numbers, integer coordinates, centres and corners.

Voxel i of an axis spans [i, i + 1) voxel sizes from the world's origin. Block b holds voxels 8b ..
8b + 7; inside a block, voxel (x, y, z) is number 64 x + 8 y + z.
"""

import functools

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..backends import piece
from .block_pool import BLOCK_VOXELS, VOXELS_PER_BLOCK

CORNERS = torch.tensor([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)])
"""Corner c = x + 2 y + 4 z of a unit cube. [8, 3]"""


@functools.cache
def corners(device: torch.device) -> Int[Tensor, "8 3"]:
    """``CORNERS`` on a device; copied there once, because a GPU is waited for."""
    return CORNERS.to(device)


VOXELS = torch.tensor([[x, y, z] for x in range(8) for y in range(8) for z in range(8)])
"""Place of voxel 64 x + 8 y + z in its block. [512, 3]"""


@piece
def block_of(ijk: Int[Tensor, "*N 3"]) -> Int[Tensor, "*N 3"]:
    """The block that contains each voxel: floor(ijk / 8). A shift by three bits rounds down below
    zero, too."""
    return ijk >> 3


def voxels_of(blocks: Int[Tensor, "B 3"]) -> Int[Tensor, "B 512 3"]:
    """Integer coordinates of the voxels of some blocks, given by theirs. int64"""
    return BLOCK_VOXELS * blocks[:, None].long() + VOXELS.to(blocks.device)


def voxel_at(block_coords: Int[Tensor, "B 3"], flat: Int[Tensor, " N"]) -> Int[Tensor, "N 3"]:
    """Integer coordinates of voxels of a volume, given by their position in its flattened pool.
    int64

    Args:
        block_coords: Of the blocks of the volume. [B, 3]
        flat: Row of the block * 512 + number in the block. [N]
    """
    blocks = block_coords[flat // VOXELS_PER_BLOCK].long()
    return BLOCK_VOXELS * blocks + VOXELS.to(flat.device)[flat % VOXELS_PER_BLOCK]


def voxel_centres(ijk: Int[Tensor, "*N 3"], voxel_size_m: float) -> Float[Tensor, "*N 3"]:
    """Centres of voxels: what the values of a voxel stand for. World frame, metres. float64"""
    return (ijk.double() + 0.5) * voxel_size_m


def block_corners(blocks: Int[Tensor, "B 3"], block_size_m: float) -> Float[Tensor, "B 8 3"]:
    """Corners of blocks, given by their integer coordinates. World frame, metres. float64"""
    return (blocks[:, None].double() + corners(blocks.device)) * block_size_m
