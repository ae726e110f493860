"""Fold a frame into the volume, one pass over its blocks to find those in view, one over voxels:
``integrate.cu``."""

from typing import Any

import torch

from gsfusion_nb.tsdf.integrate import fuse_frame_ as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Frame

from ..runtime.arguments import check_dtype, lens_of, packed, parts
from ..runtime.cuda.launch import device_of, launch

_BLOCK = 128
_RESIDENT = 132 * 16
"""Blocks of threads: as many as an H100 has room for or more; each takes one voxel block after
another."""
_OBSERVED = 1
_N_COUNTS = 2
"""Which of the counts of a frame is the number of observed voxels; as in ``integrate.cu``."""


def fuse_frame_(volume: TsdfVolume, frame: Frame) -> int:
    """See ``gsfusion_nb.tsdf.integrate.fuse_frame_``; the published averages are left to the
    reference."""
    device = device_of("fuse_frame_", volume.D)
    check_dtype("fuse_frame_", torch.float32, volume=volume.D, depth_m=frame.depth_m, rgb=frame.rgb)
    n = volume.n_blocks
    if not n:
        return 0
    if volume.config.average != "mean":
        return reference.reference(volume, frame)
    rows = torch.empty(n, dtype=torch.int32, device=device)
    count = torch.zeros(_N_COUNTS, dtype=torch.int32, device=device)
    coords = volume.block_coords
    view, images, band = view_of(volume, frame)
    blocks = parts(n, _BLOCK)
    launch(
        "fuse_frame_",
        "integrate:visible_blocks",
        blocks,
        _BLOCK,
        view,
        coords,
        n,
        band["far"],
        rows,
        count,
    )
    blocks = min(n, _RESIDENT)
    voxels = voxels_of(volume)
    launch(
        "fuse_frame_",
        "integrate:fuse_blocks",
        blocks,
        _BLOCK,
        view,
        coords,
        images,
        band,
        voxels,
        rows,
        count,
    )
    return int(count[_OBSERVED])


def view_of(
    volume: TsdfVolume,
    frame: Frame,
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """What ``voxel.cuh`` is given of a frame and of the settings of a volume."""
    camera = frame.camera
    config = volume.config
    view = lens_of(camera)._asdict() | {
        "T_WC": packed(frame.T_WC.to(volume.device, torch.float32)),
        "voxel": config.voxel_size_m,
        "width": camera.width,
        "height": camera.height,
    }
    colour_band_m = config.colour_band_voxels * config.voxel_size_m
    band = {
        "far": config.far_m + config.truncation_m,
        "near": config.near_m,
        "truncation": config.truncation_m,
        "inv_truncation": 1.0 / config.truncation_m,
        "max_weight": config.max_weight,
        "inv_colour_band": 1.0 / colour_band_m if colour_band_m else 0.0,
        "ray": config.sdf == "ray",
        "by_distance": config.colour_by_distance,
        "falling": config.colour_weights == "falling",
    }
    return view, {"depth": packed(frame.depth_m), "rgb": packed(frame.rgb)}, band


def voxels_of(volume: TsdfVolume) -> dict[str, Any]:
    """The values of the voxels, with colours in planes."""
    return {"D": volume.D, "W": volume.W, "planes": volume.rgb_planes, "W_rgb": volume.W_rgb}
