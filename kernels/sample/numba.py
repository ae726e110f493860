"""Voxel values at points: the seed test of every quadtree cell, one look-up a point."""

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.backends import load, use_backend
from gsfusion_nb.tsdf import NewBlocks, TsdfSample, TsdfVolume
from gsfusion_nb.tsdf import sample_voxels as reference
from gsfusion_nb.types import Frame

from ..runtime.arguments import IN_NODE, NODE_BITS, NODE_SHIFT, BlockTable
from ..runtime.numba.launch import launching

f32 = np.float32
_FARTHEST = f32(1 << 24)
"""Voxel numbers beyond this are not whole in float32, and no block is there."""


def sample_voxels(volume: TsdfVolume, xyz_W: Tensor) -> TsdfSample:
    """See ``gsfusion_nb.tsdf.sample_voxels``."""
    blocks = volume.index.table
    if xyz_W.dtype != torch.float32 or volume.device.type != "cpu" or blocks is None:
        with use_backend("reference"):
            return reference(volume, xyz_W)
    n = xyz_W.shape[0]
    D = torch.empty(n)
    W = torch.empty(n)
    rgb = torch.empty(n, 3)
    W_rgb = torch.empty(n)
    voxels = tuple(field.numpy() for field in (volume.D, volume.W, volume.rgb_planes, volume.W_rgb))
    samples = tuple(field.numpy() for field in (D, W, rgb, W_rgb))
    points = xyz_W.detach().contiguous().numpy()
    with launching():
        _sample(BlockTable.of(blocks), voxels, points, f32(volume.config.voxel_size_m), samples)
    return TsdfSample(D=D, W=W, rgb=rgb, W_rgb=W_rgb)


def sample_fused_voxels(
    volume: TsdfVolume, frame: Frame, missing: NewBlocks, xyz_W: Tensor
) -> TsdfSample:
    """See ``gsfusion_nb.tsdf.sample_fused_voxels``: it is that function, whose look-ups run on this
    backend."""
    return load("sample_fused_voxels", "reference")(volume, frame, missing, xyz_W)


@njit(parallel=True, cache=True, error_model="numpy")
def _sample(table, voxels, points, voxel_size, samples):
    """The values at the points; where no block is allocated D is 1, W 0 and the colour black.

    voxels: D [B, 512], W, planes of colour [B, 3, 512] and W_rgb of the blocks in the pool. out: of
    the points.
    """
    nodes = table.nodes
    rows = table.rows
    low = table.low
    size = table.size
    field_D, field_W, field_rgb, field_W_rgb = voxels
    D, W, rgb, W_rgb = samples
    N = points.shape[0]
    chunk = 1024
    for part in prange((N + chunk - 1) // chunk):
        for i in range(part * chunk, min(N, part * chunk + chunk)):
            D[i] = f32(1)
            W[i] = f32(0)
            W_rgb[i] = f32(0)
            rgb[i, 0] = f32(0)
            rgb[i, 1] = f32(0)
            rgb[i, 2] = f32(0)
            x = points[i, 0] / voxel_size
            y = points[i, 1] / voxel_size
            z = points[i, 2] / voxel_size
            if not (abs(x) < _FARTHEST and abs(y) < _FARTHEST and abs(z) < _FARTHEST):
                continue
            vx = int(math.floor(x))
            vy = int(math.floor(y))
            vz = int(math.floor(z))
            X = (vx >> NODE_SHIFT) - low[0]
            Y = (vy >> NODE_SHIFT) - low[1]
            Z = (vz >> NODE_SHIFT) - low[2]
            if not (0 <= X < size[0] and 0 <= Y < size[1] and 0 <= Z < size[2]):
                continue
            node = int(nodes[(X * size[1] + Y) * size[2] + Z])
            bx = vx >> 3 & IN_NODE
            by = vy >> 3 & IN_NODE
            bz = vz >> 3 & IN_NODE
            row = rows[(((node << NODE_BITS | bx) << NODE_BITS | by) << NODE_BITS) | bz]
            if row < 0:
                continue
            at = 64 * (vx & 7) + 8 * (vy & 7) + (vz & 7)
            D[i] = field_D[row, at]
            W[i] = field_W[row, at]
            W_rgb[i] = field_W_rgb[row, at]
            for c in range(3):
                rgb[i, c] = field_rgb[row, c, at]
