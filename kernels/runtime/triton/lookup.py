"""Voxels by their coordinates, through the dense table of ``tsdf.octree.BlockIndex``."""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportIndexIssue=false

import triton
import triton.language as tl

from gsfusion_nb.constants import VOXELS_PER_BLOCK

_VOXELS = tl.constexpr(VOXELS_PER_BLOCK)
_BITS_OF_VOXEL = tl.constexpr(VOXELS_PER_BLOCK.bit_length() - 1)
"""Of a voxel's place in the pool, those that number it within its block."""


@triton.jit
def find_row(table, low, nx, ny, nz, X, Y, Z, mask):
    """Pool rows of blocks, -1 where not allocated or not asked for. ``low``: int64 [3], lowest block of the table."""
    i, j, k = X - tl.load(low).to(tl.int32), Y - tl.load(low + 1).to(tl.int32), Z - tl.load(low + 2).to(tl.int32)
    inside = mask & (i >= 0) & (i < nx) & (j >= 0) & (j < ny) & (k >= 0) & (k < nz)
    return tl.load(table + (i * ny + j) * nz + k, mask=inside, other=-1)


@triton.jit
def find_voxel(table, low, nx, ny, nz, x, y, z, mask):
    """Places of voxels in the pool, -1 where not allocated or not asked for. int64"""
    row = find_row(table, low, nx, ny, nz, x >> 3, y >> 3, z >> 3, mask)
    number = (x & 7) * 64 + (y & 7) * 8 + (z & 7)
    return tl.where(row >= 0, row.to(tl.int64) * _VOXELS + number, -1)


@triton.jit
def load_colour(rgb, at, channel, mask):
    """One channel of voxels, whose colours are stored plane by plane within a block."""
    return tl.load(
        rgb + (at >> _BITS_OF_VOXEL) * (3 * _VOXELS) + channel * _VOXELS + (at & (_VOXELS - 1)), mask=mask, other=0.0
    )
