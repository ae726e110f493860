"""Voxel values at points, before and after a frame is fused, one look-up a point: ``sample.cu``."""

from typing import Any

import torch
from torch import Tensor

from gsfusion_nb import tsdf
from gsfusion_nb.tsdf import TsdfSample, TsdfVolume
from gsfusion_nb.types import Frame

from ..integrate.cuda import view_of, voxels_of
from ..runtime.arguments import check_dtype, packed, parts
from ..runtime.cuda.launch import device_of, launch

_BLOCK = 128


def sample_voxels(volume: TsdfVolume, xyz_W: Tensor) -> TsdfSample:
    """See ``gsfusion_nb.tsdf.sample_voxels``."""
    device_of("sample_voxels", volume.D)
    if _is_left_to_the_reference(volume, xyz_W):
        return tsdf.sample_voxels.reference(volume, xyz_W)
    points = _points(xyz_W)
    out = _blank(xyz_W)
    blocks = parts(len(xyz_W), _BLOCK)
    values = (table_of(volume), voxels_of(volume))
    size = volume.config.voxel_size_m
    launch(
        "sample_voxels", "sample:sample_voxels", blocks, _BLOCK, points, *values, size, vars(out)
    )
    return out


def sample_fused_voxels(
    volume: TsdfVolume, frame: Frame, missing: tsdf.NewBlocks, xyz_W: Tensor
) -> TsdfSample:
    """See ``gsfusion_nb.tsdf.sample_fused_voxels``; the published averages are left to the
    reference."""
    name = "sample_fused_voxels"
    images = {"depth_m": frame.depth_m, "rgb": frame.rgb}
    device_of(name, volume.D)
    check_dtype(name, torch.float32, volume=volume.D, **images)
    if volume.config.average != "mean" or _is_left_to_the_reference(volume, xyz_W):
        return tsdf.sample_fused_voxels.reference(volume, frame, missing, xyz_W)
    points = _points(xyz_W)
    out = _blank(xyz_W)
    blocks = parts(len(xyz_W), _BLOCK)
    values = (table_of(volume), voxels_of(volume))
    fresh = {"codes": packed(missing.codes), "count": len(missing)}
    view = view_of(volume, frame)
    launch(
        name, "sample:sample_fused_voxels", blocks, _BLOCK, points, *values, fresh, *view, vars(out)
    )
    return out


def _is_left_to_the_reference(volume: TsdfVolume, xyz_W: Tensor) -> bool:
    """Points in float64, and a map that is too large for a table."""
    return xyz_W.dtype != torch.float32 or volume.index.table is None


def _points(xyz_W: Tensor) -> dict[str, Any]:
    """Where to look."""
    return {"xyz": packed(xyz_W), "count": len(xyz_W)}


def _blank(xyz_W: Tensor) -> TsdfSample:
    """A result that a kernel is to fill."""
    D, W, rgb, W_rgb = (
        torch.empty(len(xyz_W), *k, device=xyz_W.device) for k in ((), (), (3,), ())
    )
    return TsdfSample(D=D, W=W, rgb=rgb, W_rgb=W_rgb)


def table_of(volume: TsdfVolume) -> dict[str, Any]:
    """Where the blocks are, of a map that is not too large for a table."""
    table = volume.index.table
    assert table is not None
    return {
        "nodes": table.nodes,
        "rows": table.rows,
        "low": table.low,
        "size": tuple(table.nodes.shape),
    }
