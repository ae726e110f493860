"""Fold a frame into the volume, one pass over its blocks to find those in view, one over voxels: ``integrate.cu``."""

import ctypes
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from gsfusion_nb import types
from gsfusion_nb.tsdf.integrate import fuse_frame_ as reference
from gsfusion_nb.tsdf.volume import TsdfVolume

from ..runtime.cuda.launch import device_of, launch
from ..runtime.gpu import check_dtype, packed, parts
from ..runtime.lens import lens_of

_BLOCK = 128
_RESIDENT = 132 * 16
"""Blocks of threads: as many as an H100 has room for or more; each takes one voxel block after another."""
_OBSERVED, _N_COUNTS = 1, 2
"""Which of the counts of a frame is the number of observed voxels; as in ``integrate.cu``."""

Double = Annotated[float, ctypes.c_double]


class View(NamedTuple):
    """The blocks, where the camera is, its lens and the edge of a voxel, and the size of the images."""

    coords: Tensor
    T_WC: Tensor
    fx: Double
    fy: Double
    cx: Double
    cy: Double
    voxel: Double
    width: int
    height: int


class Frame(NamedTuple):
    """The images."""

    depth: Tensor
    rgb: Tensor


class Band(NamedTuple):
    """Around the measured depth, metres; the largest weight; whether distances are along the ray."""

    near: float
    truncation: float
    inv_truncation: float
    max_weight: float
    ray: bool


class Voxels(NamedTuple):
    """To be updated."""

    D: Tensor
    W: Tensor
    planes: Tensor


def fuse_frame_(volume: TsdfVolume, frame: types.Frame) -> int:
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
    count = torch.zeros(_N_COUNTS, dtype=torch.int32, device=device)
    view = View(
        coords=volume.block_coords,
        T_WC=pose,
        **lens_of(camera)._asdict(),
        voxel=config.voxel_size_m,
        width=camera.width,
        height=camera.height,
    )
    far = float(config.far_m + config.truncation_m)
    launch("fuse_frame_", "integrate:visible_blocks", parts(n, _BLOCK), _BLOCK, view, n, far, rows, count)
    band = Band(
        near=config.near_m,
        truncation=config.truncation_m,
        inv_truncation=1.0 / config.truncation_m,
        max_weight=config.max_weight,
        ray=config.sdf == "ray",
    )
    images = Frame(depth=packed(frame.depth_m), rgb=packed(frame.rgb))
    voxels = Voxels(D=volume.D, W=volume.W, planes=volume.rgb_planes)
    launch("fuse_frame_", "integrate:fuse_blocks", min(n, _RESIDENT), _BLOCK, view, images, band, voxels, rows, count)
    return int(count[_OBSERVED])
