"""A preview of a volume with a frame fused into it, without changing the volume."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..geometry import se3
from ..types import Frame
from .integrate import corners_in_view, fuse_voxels
from .morton import OFFSET, interleave
from .volume import TsdfSample, TsdfVolume


class FusedView:
    """Looks up single voxels of a volume as if ``frame`` were already fused; the volume is not changed.

    GSFusion's seeding rules need the volume with the frame fused into it. With this view they can run before it is
    fused, so that a rule that fails leaves the map unchanged.

    Args:
        volume: The volume before the frame.
        frame: The frame that will be fused.
        missing: The blocks that will be allocated for it, from ``TsdfVolume.make_room``. [M, 3]
    """

    def __init__(self, volume: TsdfVolume, frame: Frame, missing: Int[Tensor, "M 3"]):
        self.config = volume.config
        self._volume, self._frame = volume, frame
        self._new = interleave(missing).sort().values
        self._T_CW = se3.inverse(frame.T_WC.double())

    def sample_nearest(self, xyz_W: Float[Tensor, "N 3"]) -> TsdfSample:
        """Values that the voxels containing the points will have.

        Args:
            xyz_W: Points, world frame, metres. [N, 3]

        Differentiable: no.
        """
        volume, config = self._volume, self.config
        before = volume.sample_nearest(xyz_W)
        ijk = volume.voxel_index(xyz_W)
        block = ijk >> 3
        in_view = corners_in_view(volume.corners_of(block), config, self._frame.camera, self._T_CW)
        changes = self._is_allocated(block) & in_view
        after, _ = fuse_voxels(before, se3.apply(self._T_CW, volume.centres_of(ijk)), self._frame, config)
        return TsdfSample(
            D=after.D.where(changes, before.D),
            W=after.W.where(changes, before.W),
            rgb=after.rgb.where(changes[:, None], before.rgb),
        )

    def _is_allocated(self, block: Int[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Whether each block exists, or will exist."""
        exists = self._volume.index.find(block) >= 0
        if not len(self._new):
            return exists
        codes = interleave(block.clamp(-OFFSET, OFFSET - 1))
        at = torch.searchsorted(self._new, codes).clamp(max=len(self._new) - 1)
        return exists | (self._new[at] == codes)
