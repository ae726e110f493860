"""A preview of a volume with a frame fused into it; the volume does not change."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..backends import op
from ..errors import ArgumentError
from ..geometry import se3
from ..geometry.operands import check_operand
from ..types import Camera, Frame
from .integrate import check_fuse, corners_in_view, fuse_frame_
from .octree import NewBlocks
from .raycast import RaycastOutput, raycast
from .volume import TsdfSample, TsdfVolume, sample_voxels
from .voxel_update import fuse_voxels
from .voxels import block_corners, block_of, voxel_centres


class FusedView:
    """Shows a volume as if ``frame`` were already fused; the volume is not changed.

    GSFusion's seeding rules need the volume with the frame fused into it. With this view they can
    run before it is fused, so that a rule that fails leaves the map unchanged.

    Args:
        volume: The volume before the frame.
        frame: The frame that will be fused.
        missing: The blocks that will be allocated for it, from ``new_band_blocks``.
    """

    def __init__(self, volume: TsdfVolume, frame: Frame, missing: NewBlocks):
        self.config = volume.config
        self._volume = volume
        self._frame = frame
        self._missing = missing

    def sample_nearest(self, xyz_W: Float[Tensor, "N 3"]) -> TsdfSample:
        """Values that the voxels containing the points will have.

        Args:
            xyz_W: Points, world frame, metres. [N, 3]

        Differentiable: no.
        """
        return sample_fused_voxels(self._volume, self._frame, self._missing, xyz_W)

    def raycast(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RaycastOutput:
        """The surface that a camera will see; computed in a copy of the volume into which the frame
        is fused.

        Raises:
            MemoryError: no room for the copy.

        Differentiable: no.
        """
        copy = self._volume.to(self._volume.device)
        copy.add_blocks(self._missing.coords)
        fuse_frame_(copy, self._frame)
        return raycast(copy, camera, T_WC)


def check_sample_fused(volume: Any, frame: Any, missing: Any, xyz_W: Any) -> None:
    """Raise ``ValueError`` for arguments that ``sample_fused_voxels`` refuses."""
    check_fuse(volume, frame)
    if not isinstance(missing, NewBlocks):
        raise ArgumentError(f"missing must be NewBlocks, got {type(missing).__name__}")
    device = volume.D.device
    check_operand(
        "codes",
        missing.codes,
        ("M",),
        dtypes=(torch.int64,),
        device=device,
    )
    check_operand(
        "coords",
        missing.coords,
        (len(missing), 3),
        dtypes=(torch.int64,),
        device=device,
    )
    check_operand("xyz_W", xyz_W, ("N", 3), device=device)


@op("sample", check_sample_fused)
def sample_fused_voxels(
    volume: TsdfVolume, frame: Frame, missing: NewBlocks, xyz_W: Float[Tensor, "N 3"]
) -> TsdfSample:
    """Values that voxels will have; the operation behind ``FusedView.sample_nearest``.

    Raises:
        ValueError: the pose is not rigid.

    Source: GSFusion III-B.1, Eq. 6-9. Differentiable: no.
    """
    T_CW = se3.inverse(frame.T_WC.double())
    before = sample_voxels(volume, xyz_W)
    ijk = volume.voxel_index(xyz_W)
    block = block_of(ijk)
    corners_W = block_corners(block, volume.block_size_m)
    in_view = corners_in_view(corners_W, volume.config, frame.camera, T_CW)
    changes = ((volume.index.find(block) >= 0) | missing.contains(block)) & in_view
    after, _ = fuse_voxels(
        before,
        se3.apply(T_CW, voxel_centres(ijk, volume.config.voxel_size_m)),
        frame,
        volume.config,
    )
    return TsdfSample(
        D=after.D.where(changes, before.D),
        W=after.W.where(changes, before.W),
        rgb=after.rgb.where(changes[:, None], before.rgb),
        W_rgb=after.W_rgb.where(changes, before.W_rgb),
    )
