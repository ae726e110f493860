"""Fold a frame into the volume, one pass over its blocks to find those in view, one over voxels: ``integrate.cu``."""

import ctypes

import torch
from torch import Tensor

from gsfusion_nb.tsdf.integrate import fuse_frame_ as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Frame

from ..runtime.cuda.launch import check_dtype, device_of, launch, packed, parts

_BLOCK = 128
_RESIDENT = 132 * 16
"""Blocks of threads: as many as an H100 has room for or more; each takes one voxel block after another."""


def fuse_frame_(volume: TsdfVolume, frame: Frame) -> int:
    """See ``gsfusion_nb.tsdf.integrate.fuse_frame_``; the published averages are left to the reference."""
    device = device_of("fuse_frame_", volume=volume.D, depth_m=frame.depth_m, rgb=frame.rgb)
    check_dtype("fuse_frame_", torch.float32, volume=volume.D, depth_m=frame.depth_m, rgb=frame.rgb)
    n, camera, config = volume.n_blocks, frame.camera, volume.config
    if not n:
        return 0
    if config.average != "mean":
        return reference.reference(volume, frame)
    pose = packed(frame.T_WC.to(device, torch.float32))
    rows = torch.empty(n, dtype=torch.int32, device=device)
    count = torch.zeros(2, dtype=torch.int32, device=device)
    lens = (camera.fx, camera.fy, camera.cx, camera.cy, config.voxel_size_m)
    view = (volume.block_coords, pose, *(ctypes.c_double(x) for x in lens), rows, count)
    far = float(config.far_m + config.truncation_m)
    launch(
        "fuse_frame_", "integrate:visible_blocks", parts(n, _BLOCK), _BLOCK, *view, n, camera.width, camera.height, far
    )
    images = (packed(frame.depth_m), packed(frame.rgb))
    band = (config.near_m, config.truncation_m, 1.0 / config.truncation_m, config.max_weight)
    launch(
        "fuse_frame_", "integrate:fuse_blocks", min(n, _RESIDENT), _BLOCK, *view, *_voxels(volume), *images,
        camera.width, camera.height, *(float(x) for x in band), config.sdf == "ray",
    )  # fmt: skip
    return int(count[1])


def _voxels(volume: TsdfVolume) -> tuple[Tensor, Tensor, Tensor]:
    return volume.D, volume.W, volume.rgb_planes
