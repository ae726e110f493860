"""Voxel values at points: the seed test of every quadtree cell, one look-up a point."""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportIndexIssue=false
# pyright: reportGeneralTypeIssues=false

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsfusion_nb.backends import use_backend
from gsfusion_nb.tsdf import TsdfSample, TsdfVolume
from gsfusion_nb.tsdf import sample_voxels as reference

from ..runtime.triton.launch import device_of, launch, parts
from ..runtime.triton.lookup import find_voxel, load_colour
from ..runtime.triton.vectors import load3

_BLOCK = 128
_FARTHEST = tl.constexpr(float(1 << 24))
"""Voxel numbers beyond this are not whole in float32, and no block is there."""


def sample_voxels(volume: TsdfVolume, xyz_W: Tensor) -> TsdfSample:
    """See ``gsfusion_nb.tsdf.sample_voxels``."""
    lookup = volume.index.table
    if xyz_W.dtype != torch.float32 or lookup is None:
        with use_backend("reference"):
            return reference(volume, xyz_W)
    table, low, (blocks_x, blocks_y, blocks_z) = lookup
    device = device_of("sample_voxels", volume=volume.D, xyz_W=xyz_W)
    n = xyz_W.shape[0]
    D, W, rgb = (torch.empty(n, *k, dtype=torch.float32, device=device) for k in ((), (), (3,)))
    launch(
        _sample,
        parts(n, _BLOCK),
        device,
        points=xyz_W.detach().contiguous(),
        table=table,
        low=low,
        nx=blocks_x,
        ny=blocks_y,
        nz=blocks_z,
        D=volume.D,
        W=volume.W,
        rgb=volume.rgb_planes,
        out_D=D,
        out_W=W,
        out_rgb=rgb,
        n=n,
        voxel=float(volume.config.voxel_size_m),
        BLOCK=_BLOCK,
        num_warps=4,
    )
    return TsdfSample(D=D, W=W, rgb=rgb)


@triton.jit(do_not_specialize=["n", "nx", "ny", "nz", "voxel"])
def _sample(
    points, table, low, D, W, rgb, out_D, out_W, out_rgb, n, nx, ny, nz, voxel, BLOCK: tl.constexpr
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < n
    x, y, z = load3(points, i, here)
    x, y, z = x / voxel, y / voxel, z / voxel
    near = here & (tl.abs(x) < _FARTHEST) & (tl.abs(y) < _FARTHEST) & (tl.abs(z) < _FARTHEST)
    x, y, z = tl.where(near, x, 0.0), tl.where(near, y, 0.0), tl.where(near, z, 0.0)
    x, y, z = tl.floor(x).to(tl.int32), tl.floor(y).to(tl.int32), tl.floor(z).to(tl.int32)
    at = find_voxel(table, low, nx, ny, nz, x, y, z, near)
    known = at >= 0
    tl.store(out_D + i, tl.load(D + at, mask=known, other=1.0), mask=here)
    tl.store(out_W + i, tl.load(W + at, mask=known, other=0.0), mask=here)
    for channel in tl.static_range(3):
        tl.store(out_rgb + 3 * i + channel, load_colour(rgb, at, channel, known), mask=here)
