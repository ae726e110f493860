"""Fuse one RGB-D frame into the volume (GSFusion III-B.1, Eq. 6-9; Curless & Levoy 1996)."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import op
from ..checks import check_pose
from ..config import TsdfConfig
from ..errors import ArgumentError
from ..geometry import se3
from ..geometry.operands import check_frame_on
from ..types import Camera, Frame
from .allocate import allocate, new_band_blocks
from .volume import TsdfSample, TsdfVolume, check_volume
from .voxel_update import fuse_voxels
from .voxels import block_corners, voxel_centres, voxels_of

BLOCKS_AT_A_TIME = 256
"""Limits the memory for intermediate results, independent of the size of the map."""


@dataclass(frozen=True, kw_only=True)
class IntegrateReport:
    """How one frame changed the volume."""

    new_blocks: int
    """Blocks allocated."""
    updated_voxels: int
    """Voxels that received an observation."""


def integrate(volume: TsdfVolume, frame: Frame) -> IntegrateReport:
    """Allocate what ``frame`` needs and update every voxel that it observes; the volume changes in
    place.

    A voxel is observed when its centre projects into the image, the pixel that contains the
    projection has depth, and the voxel is not further than the truncation behind it. Voxels in
    front, however far, are observed as free (D = 1).

    Raises:
        ValueError: the pose is not rigid. MemoryError: no room for the new blocks.

    Differentiable: no (the map is state, not a parameter).
    """
    new_rows = allocate(volume, frame)
    return IntegrateReport(new_blocks=new_rows.shape[0], updated_voxels=fuse_frame_(volume, frame))


def check_fuse(volume: Any, frame: Any) -> None:
    """Raise ``ValueError`` for arguments that ``fuse_frame_`` refuses."""
    check_volume(volume)
    check_frame_on(frame, volume.device)
    if frame.T_WC.device.type == "cpu":
        check_pose("T_WC", frame.T_WC)


def check_fuse_frame(volume: Any, frame: Any) -> None:
    """As ``check_fuse``; and a volume without any block takes nothing of a frame that needs
    some."""
    check_fuse(volume, frame)
    if not volume.n_blocks and len(new_band_blocks(volume, frame)):
        raise ArgumentError(
            "the volume has no voxel blocks, so nothing can be fused into it; integrate(volume, "
            "frame) makes those that the frame needs and fuses it"
        )


@op("integrate", check_fuse_frame)
def fuse_frame_(volume: TsdfVolume, frame: Frame) -> int:
    """Update the allocated voxels that ``frame`` observes, in place; returns how many it observes.

    It makes no blocks: ``integrate`` does, and then calls this.

    Raises:
        ValueError: the pose is not rigid; or the volume has no blocks although the frame needs
            some.
    """
    T_CW = se3.inverse(frame.T_WC.double())
    rows = blocks_in_view(volume, frame.camera, T_CW)
    return sum(_fuse_blocks(volume, part, frame, T_CW) for part in rows.split(BLOCKS_AT_A_TIME))


def blocks_in_view(
    volume: TsdfVolume, camera: Camera, T_CW: Float[Tensor, "4 4"]
) -> Int[Tensor, " K"]:
    """Rows of the blocks that may reach into the view: up to ``far_m`` and the truncation, and
    between its four sides.

    A block whose eight corners all lie outside the same side of the view is not in view.
    """
    corners_W = block_corners(volume.block_coords, volume.block_size_m)
    return corners_in_view(corners_W, volume.config, camera, T_CW).nonzero()[:, 0]


def corners_in_view(
    corners_W: Float[Tensor, "B 8 3"],
    config: TsdfConfig,
    camera: Camera,
    T_CW: Float[Tensor, "4 4"],
) -> Bool[Tensor, " B"]:
    """Which blocks, given by their corners, may reach into the view; see ``blocks_in_view``."""
    x, y, z = se3.apply(T_CW, corners_W).unbind(-1)
    within = [
        z,
        config.far_m + config.truncation_m - z,
        camera.fx * x + camera.cx * z,  # u >= 0
        (camera.width - camera.cx) * z - camera.fx * x,  # u <= width
        camera.fy * y + camera.cy * z,  # v >= 0
        (camera.height - camera.cy) * z - camera.fy * y,  # v <= height
    ]
    return torch.stack([(distance > 0).any(1) for distance in within]).all(0)


def _fuse_blocks(
    volume: TsdfVolume,
    rows: Int[Tensor, " B"],
    frame: Frame,
    T_CW: Float[Tensor, "4 4"],
) -> int:
    """Update the voxels of some blocks from a frame, in place; returns how many were observed."""
    before = TsdfSample(
        D=volume.D[rows],
        W=volume.W[rows],
        rgb=volume.rgb[rows],
        W_rgb=volume.W_rgb[rows],
    )
    centres_C = se3.apply(
        T_CW, voxel_centres(voxels_of(volume.block_coords[rows]), volume.config.voxel_size_m)
    )
    after, observed = fuse_voxels(before, centres_C, frame, volume.config)
    volume.D[rows] = after.D
    volume.W[rows] = after.W
    volume.rgb[rows] = after.rgb
    volume.W_rgb[rows] = after.W_rgb
    return int(observed.sum())
