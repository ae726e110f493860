"""The blocks that a view can meet, numbered from a corner: what the numba kernels mark cells in."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Frame


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockBox:
    """The blocks around a part of a view, and the view in their units, relative to them: exact far from the origin."""

    low: Int[Tensor, " 3"]
    """Lowest block."""
    size: list[int]
    """Blocks along each axis."""
    origin: list[float]
    """Camera centre, blocks from the corner of ``low``."""
    R: list[list[float]]
    """Rows of R_WC, blocks per metre."""
    block_size_m: float
    """Edge of a block, metres."""

    def pieces(self, length_m: float) -> int:
        """Parts no longer than a block, up to rounding, that a segment has to be cut into."""
        return math.ceil(1.0001 * length_m / self.block_size_m)


def block_box(volume: TsdfVolume, frame: Frame, z_near: float, z_far: float) -> BlockBox:
    """All blocks that the view frustum of ``frame`` can meet between two depths, with one to spare on each side."""
    camera, T_WC = frame.camera, frame.T_WC.double()
    position = T_WC[:3, 3] / volume.block_size_m
    base = position.floor()
    R = (T_WC[:3, :3] / volume.block_size_m).tolist()
    xs = ((0 - camera.cx) / camera.fx, (camera.width - camera.cx) / camera.fx)
    ys = ((0 - camera.cy) / camera.fy, (camera.height - camera.cy) / camera.fy)
    corners = [(x * z, y * z, z) for x in xs for y in ys for z in (z_near, z_far)]
    low, size, origin = [], [], []
    for o, (rx, ry, rz) in zip((position - base).tolist(), R, strict=True):
        along = [o + rx * x + ry * y + rz * z for x, y, z in corners]
        low.append(math.floor(min(along)) - 1)
        size.append(math.floor(max(along)) + 2 - low[-1])
        origin.append(o - low[-1])
    lowest = base.to(torch.int64) + torch.tensor(low, dtype=torch.int64, device=base.device)
    return BlockBox(low=lowest, size=size, origin=origin, R=R, block_size_m=volume.block_size_m)
