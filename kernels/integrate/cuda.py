"""Fold a frame into the volume, one pass over its blocks to find those in view, one over voxels: ``integrate.cu``."""

import ctypes
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from gsfusion_nb import types
from gsfusion_nb.tsdf.integrate import fuse_frame_ as reference
from gsfusion_nb.tsdf.volume import TsdfVolume

from ..runtime.arguments import check_dtype, lens_of, packed, parts
from ..runtime.cuda.launch import device_of, launch

_BLOCK = 128
_RESIDENT = 132 * 16
"""Blocks of threads: as many as an H100 has room for or more; each takes one voxel block after another."""
_OBSERVED, _N_COUNTS = 1, 2
"""Which of the counts of a frame is the number of observed voxels; as in ``integrate.cu``."""

Double = Annotated[float, ctypes.c_double]


class View(NamedTuple):
    """Where the camera is, its lens and the edge of a voxel, and the size of the images."""

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
    """The largest depth of a block in view, and the smallest depth that is used; around it, metres; the largest weight;
    the band of colours; whether distances are along the ray, and whether weights of colours fall with the distance."""

    far: float
    near: float
    truncation: float
    inv_truncation: float
    max_weight: float
    inv_colour_band: float
    ray: bool
    by_distance: bool


class Voxels(NamedTuple):
    """To be updated."""

    D: Tensor
    W: Tensor
    planes: Tensor
    W_rgb: Tensor


def fuse_frame_(volume: TsdfVolume, frame: types.Frame) -> int:
    """See ``gsfusion_nb.tsdf.integrate.fuse_frame_``; the published averages are left to the reference."""
    device = device_of("fuse_frame_", volume=volume.D, depth_m=frame.depth_m, rgb=frame.rgb)
    check_dtype("fuse_frame_", torch.float32, volume=volume.D, depth_m=frame.depth_m, rgb=frame.rgb)
    n = volume.n_blocks
    if not n:
        return 0
    if volume.config.average != "mean":
        return reference.reference(volume, frame)
    rows = torch.empty(n, dtype=torch.int32, device=device)
    count = torch.zeros(_N_COUNTS, dtype=torch.int32, device=device)
    coords, (view, images, band) = volume.block_coords, view_of(volume, frame)
    blocks = parts(n, _BLOCK)
    launch("fuse_frame_", "integrate:visible_blocks", blocks, _BLOCK, view, coords, n, band.far, rows, count)
    voxels = Voxels(D=volume.D, W=volume.W, planes=volume.rgb_planes, W_rgb=volume.W_rgb)
    blocks = min(n, _RESIDENT)
    launch("fuse_frame_", "integrate:fuse_blocks", blocks, _BLOCK, view, coords, images, band, voxels, rows, count)
    return int(count[_OBSERVED])


def view_of(volume: TsdfVolume, frame: types.Frame) -> tuple[View, Frame, Band]:
    """What ``voxel.cuh`` is given of a frame and of the settings of a volume."""
    camera, config = frame.camera, volume.config
    view = View(
        T_WC=packed(frame.T_WC.to(volume.device, torch.float32)),
        **lens_of(camera)._asdict(),
        voxel=config.voxel_size_m,
        width=camera.width,
        height=camera.height,
    )
    band = Band(
        far=float(config.far_m + config.truncation_m),
        near=config.near_m,
        truncation=config.truncation_m,
        inv_truncation=1.0 / config.truncation_m,
        max_weight=config.max_weight,
        inv_colour_band=1.0 / (config.colour_band_voxels * config.voxel_size_m) if config.colour_band_voxels else 0.0,
        ray=config.sdf == "ray",
        by_distance=config.colour_by_distance,
    )
    return view, Frame(depth=packed(frame.depth_m), rgb=packed(frame.rgb)), band
