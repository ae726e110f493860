"""Which voxel blocks a depth image needs: those that the viewing rays cross inside the truncation
band."""

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import op
from ..checks import check_pose
from ..errors import ArgumentError
from ..geometry import pixel_grid, rays, se3
from ..geometry.operands import check_frame_on, check_rays
from ..types import Frame
from .octree import NewBlocks
from .volume import TsdfVolume, check_volume

OUTLIER_RATIO = 0.05
"""A neighbour supports a depth pixel if their depths differ by less than this share of the pixel's
depth."""


MOST_CELLS = 1 << 20
"""Blocks on each side of the camera that can be told apart."""


def allocate(volume: TsdfVolume, frame: Frame) -> Int[Tensor, " K"]:
    """Allocate the blocks that meet the truncation band of ``frame``; returns the rows of the new
    ones.

    GSFusion III-B.1: "a ray is marched along the line of sight for each pixel, and voxel blocks are
    allocated only if they fall into the specified band around the depth measurement".
    """
    return volume.allocate_missing(volume.reserve(new_band_blocks(volume, frame)))


def check_band(volume: Any, frame: Any) -> None:
    """Raise ``ValueError`` for arguments that ``band_blocks`` refuses."""
    check_volume(volume)
    check_frame_on(frame, volume.device)
    check_pose("T_WC", frame.T_WC_cpu)
    check_rays("the frame's camera", frame.camera)


@op("allocate", check_band)
def band_blocks(volume: TsdfVolume, frame: Frame) -> Int[Tensor, "N 3"]:
    """Coordinates of all blocks that the band of any pixel's ray crosses, each once, sorted by x,
    y, z.

    The band is ``depth +- truncation`` along z (``sdf="z"``) or along the ray (``sdf="ray"``).
    Pixels outside ``near_m`` .. ``far_m`` and, with ``outlier_guard``, isolated ones are ignored.
    The crossing is exact: no block is skipped at a corner, and no pixel is skipped.

    Raises:
        ValueError: the pose is not rigid, or the camera impossible: its rays would cross millions
            of blocks.
    """
    config = volume.config
    depth_m = frame.depth_m
    used = (depth_m > 0) & (depth_m >= config.near_m) & (depth_m <= config.far_m)
    if config.outlier_guard:
        used &= has_support(depth_m)
    ray_C = rays(
        frame.camera, pixel_grid(frame.camera, device=depth_m.device, dtype=depth_m.dtype)
    )[used]
    z = depth_m[used]
    half_m = config.truncation_m / ray_C.norm(dim=1) if config.sdf == "ray" else config.truncation_m

    direction = se3.rotate(frame.T_WC.to(z), ray_C) / volume.block_size_m
    position = frame.T_WC[:3, 3].double() / volume.block_size_m
    # counted from the camera's own block, float32 is exact enough anywhere in the world
    own_block = position.floor()
    origin = (position - own_block).to(z)
    return (
        crossed_cells(
            origin,
            direction,
            (z - half_m).clamp(min=0.0),
            z + half_m,
        )
        + own_block.long()
    )


@op("allocate", check_band)
def new_band_blocks(volume: TsdfVolume, frame: Frame) -> NewBlocks:
    """Those of ``band_blocks`` that are not allocated yet.

    Raises:
        ValueError: the pose is not rigid, the camera impossible, or a block lies beyond the voxel
            index.
    """
    return volume.index.missing(band_blocks(volume, frame))


def crossed_cells(
    origin: Float[Tensor, " 3"],
    direction: Float[Tensor, "R 3"],
    t_first: Float[Tensor, " R"],
    t_last: Float[Tensor, " R"],
) -> Int[Tensor, "N 3"]:
    """Unit cells that the segments ``origin + t direction``, t from ``t_first`` to ``t_last``,
    pass; each once, sorted.

    All segments step together, each through the nearest wall of its cell (Amanatides & Woo 1987).

    Raises:
        ValueError: a segment ends ``MOST_CELLS`` or more from the origin of the cells.
    """
    farthest = (
        (origin + t_last[:, None] * direction).abs().amax() if len(direction) else torch.zeros(())
    )
    if not bool(farthest < MOST_CELLS):
        raise ArgumentError(
            f"a block {float(farthest):.3g} blocks from the camera lies beyond the voxel index, "
            f"which has {MOST_CELLS} "
            "on each side: check the depth unit, tsdf.far_m and the intrinsics"
        )
    cell = (origin + t_first[:, None] * direction).floor()
    cells_on_ray = [cell]
    while cell.shape[0]:
        wall = cell + (direction > 0)
        t_wall = ((wall - origin) / direction).where(direction != 0, torch.inf)
        t, axis = t_wall.min(dim=1)
        goes_on = t < t_last
        cell = cell[goes_on]
        direction = direction[goes_on]
        axis = axis[goes_on]
        t_last = t_last[goes_on]
        cell = cell + direction.sign() * torch.nn.functional.one_hot(axis, 3)
        cells_on_ray.append(cell)
    return _distinct(torch.cat(cells_on_ray).long())


def has_support(
    depth_m: Float[Tensor, "H W"],
    ratio: float = OUTLIER_RATIO,
) -> Bool[Tensor, "H W"]:
    """Pixels with at least one of their eight neighbours within ``ratio`` of their own depth.

    A lone pixel at a wrong depth would otherwise allocate blocks in free space.
    """
    H, W = depth_m.shape
    around = torch.nn.functional.pad(
        depth_m,
        (1, 1, 1, 1),
        value=torch.inf,
    )
    neighbours = [
        around[y : y + H, x : x + W] for y in range(3) for x in range(3) if (y, x) != (1, 1)
    ]
    gaps = torch.stack([(neighbour - depth_m).abs() for neighbour in neighbours])
    return (gaps < ratio * depth_m).any(0)


def _distinct(cells: Int[Tensor, "N 3"]) -> Int[Tensor, "M 3"]:
    """Each row once, sorted; the three numbers, below ``MOST_CELLS`` in size, share one integer."""
    x, y, z = (cells + MOST_CELLS).unbind(1)
    keys = (x << 42 | y << 21 | z).unique()
    mask = (1 << 21) - 1
    parts = torch.stack([keys >> 42, keys >> 21 & mask, keys & mask], dim=1)
    return parts - MOST_CELLS
