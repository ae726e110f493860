"""Voxel values at points: the seed test of every quadtree cell, one look-up a point."""

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.backends import use_backend
from gsfusion_nb.checks import check_shape
from gsfusion_nb.tsdf import TsdfSample, TsdfVolume
from gsfusion_nb.tsdf import sample_voxels as reference

from ..runtime.numba.launch import launching

f32 = np.float32
_FARTHEST = f32(1 << 24)
"""Voxel numbers beyond this are not whole in float32, and no block is there."""


def sample_voxels(volume: TsdfVolume, xyz_W: Tensor) -> TsdfSample:
    """See ``gsfusion_nb.tsdf.sample_voxels``."""
    lookup = volume.index.table
    if xyz_W.dtype != torch.float32 or volume.device.type != "cpu" or lookup is None:
        with use_backend("reference"):
            return reference(volume, xyz_W)
    check_shape("xyz_W", xyz_W, ("N", 3))
    n = xyz_W.shape[0]
    D, W, rgb = torch.empty(n), torch.empty(n), torch.empty(n, 3)
    rows, low, size = lookup[0].numpy(), lookup[1].numpy().astype(np.int64), np.array(lookup[2], np.int64)
    field = volume.D.numpy(), volume.W.numpy(), volume.rgb_planes.numpy()
    points = xyz_W.detach().contiguous().numpy()
    with launching():
        _sample(rows, low, size, field, points, f32(volume.config.voxel_size_m), D.numpy(), W.numpy(), rgb.numpy())
    return TsdfSample(D=D, W=W, rgb=rgb)


@njit(parallel=True, cache=True, error_model="numpy")
def _sample(rows, low, size, field, points, voxel, D, W, rgb):
    """Unallocated: D 1, W 0, black. rows [cells] of the box of blocks at ``low`` of ``size``; field: D, W, rgb."""
    field_D, field_W, field_rgb = field
    N, chunk = points.shape[0], 1024
    for part in prange((N + chunk - 1) // chunk):
        for i in range(part * chunk, min(N, part * chunk + chunk)):
            D[i], W[i], rgb[i, 0], rgb[i, 1], rgb[i, 2] = f32(1), f32(0), f32(0), f32(0), f32(0)
            x, y, z = points[i, 0] / voxel, points[i, 1] / voxel, points[i, 2] / voxel
            if not (abs(x) < _FARTHEST and abs(y) < _FARTHEST and abs(z) < _FARTHEST):
                continue
            vx, vy, vz = int(math.floor(x)), int(math.floor(y)), int(math.floor(z))
            bx, by, bz = (vx >> 3) - low[0], (vy >> 3) - low[1], (vz >> 3) - low[2]
            if not (0 <= bx < size[0] and 0 <= by < size[1] and 0 <= bz < size[2]):
                continue
            row = rows[(bx * size[1] + by) * size[2] + bz]
            if row < 0:
                continue
            at = 64 * (vx & 7) + 8 * (vy & 7) + (vz & 7)
            D[i], W[i] = field_D[row, at], field_W[row, at]
            for c in range(3):
                rgb[i, c] = field_rgb[row, c, at]
