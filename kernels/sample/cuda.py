"""Voxel values at points, before and after a frame is fused, one look-up a point: ``sample.cu``."""

import ctypes
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from gsfusion_nb import tsdf
from gsfusion_nb.tsdf import TsdfSample, TsdfVolume
from gsfusion_nb.types import Frame

from ..integrate.cuda import view_of
from ..runtime.arguments import check_dtype, packed, parts
from ..runtime.cuda.launch import device_of, launch

_BLOCK = 128

Corner = Annotated[tuple[int, int, int], ctypes.c_int * 3]


class Points(NamedTuple):
    """Where to look."""

    xyz: Tensor
    count: int


class Table(NamedTuple):
    """Pool row of every block of a box, -1 where there is none; the box."""

    rows: Tensor | None
    low: Corner
    size: Corner


class Pool(NamedTuple):
    """Values of the voxels."""

    D: Tensor
    W: Tensor
    planes: Tensor
    W_rgb: Tensor


class NewBlocks(NamedTuple):
    """Sorted Morton codes of the blocks that will be allocated."""

    codes: Tensor
    count: int


class Sample(NamedTuple):
    """The results."""

    D: Tensor
    W: Tensor
    rgb: Tensor
    W_rgb: Tensor


def sample_voxels(volume: TsdfVolume, xyz_W: Tensor) -> TsdfSample:
    """See ``gsfusion_nb.tsdf.sample_voxels``."""
    device_of("sample_voxels", volume=volume.D, xyz_W=xyz_W)
    if _is_left_to_the_reference(volume, xyz_W):
        return tsdf.sample_voxels.reference(volume, xyz_W)
    points, table, pool, out = _ask(volume, xyz_W)
    blocks, size = parts(points.count, _BLOCK), float(volume.config.voxel_size_m)
    launch("sample_voxels", "sample:sample_voxels", blocks, _BLOCK, points, table, pool, size, out)
    return TsdfSample(**out._asdict())


def sample_fused_voxels(volume: TsdfVolume, frame: Frame, missing: tsdf.NewBlocks, xyz_W: Tensor) -> TsdfSample:
    """See ``gsfusion_nb.tsdf.sample_fused_voxels``; the published averages are left to the reference."""
    name, images = "sample_fused_voxels", {"depth_m": frame.depth_m, "rgb": frame.rgb}
    device_of(name, volume=volume.D, codes=missing.codes, xyz_W=xyz_W, **images)
    check_dtype(name, torch.float32, volume=volume.D, **images)
    if volume.config.average != "mean" or _is_left_to_the_reference(volume, xyz_W):
        return tsdf.sample_fused_voxels.reference(volume, frame, missing, xyz_W)
    points, table, pool, out = _ask(volume, xyz_W)
    fresh = NewBlocks(codes=packed(missing.codes), count=len(missing))
    blocks = parts(points.count, _BLOCK)
    launch(name, "sample:sample_fused_voxels", blocks, _BLOCK, points, table, pool, fresh, *view_of(volume, frame), out)
    return TsdfSample(**out._asdict())


def _is_left_to_the_reference(volume: TsdfVolume, xyz_W: Tensor) -> bool:
    """Points in float64, and a map that is too large for a table; an empty one needs none."""
    return xyz_W.dtype != torch.float32 or (volume.n_blocks > 0 and volume.index.table is None)


def _ask(volume: TsdfVolume, xyz_W: Tensor) -> tuple[Points, Table, Pool, Sample]:
    """What both kernels are given, and where they write."""
    n, lookup = len(xyz_W), volume.index.table
    rows, _, size = lookup or (None, None, (0, 0, 0))
    D, W, rgb, W_rgb = (torch.empty(n, *k, dtype=torch.float32, device=xyz_W.device) for k in ((), (), (3,), ()))
    return (
        Points(xyz=packed(xyz_W), count=n),
        Table(rows=rows, low=volume.index.table_low, size=size),
        Pool(D=volume.D, W=volume.W, planes=volume.rgb_planes, W_rgb=volume.W_rgb),
        Sample(D=D, W=W, rgb=rgb, W_rgb=W_rgb),
    )
