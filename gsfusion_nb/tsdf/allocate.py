"""Which voxel blocks a depth image needs: those that the viewing rays cross inside the truncation band."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import op
from ..checks import check_pose
from ..types import Camera, Frame
from .volume import TsdfVolume

OUTLIER_RATIO = 0.05
"""A neighbour supports a depth pixel if it differs by less than this part of its depth."""

_BITMAP_CELLS = 1 << 24
"""Largest bounding box marked cell by cell; float32 counts exactly up to here."""

_CHUNK_PX = 1 << 16
"""Pixels traversed at a time, so that the temporaries stay in the cache."""


def allocate(volume: TsdfVolume, frame: Frame) -> Int[Tensor, " K"]:
    """Allocate the blocks that meet the truncation band of ``frame``; returns the rows of the new ones.

    GSFusion III-B.1: "a ray is marched along the line of sight for each pixel, and voxel blocks are allocated only if
    they fall into the specified band around the depth measurement".
    """
    return volume.add_blocks(band_blocks(volume, frame))


@op("allocate")
def band_blocks(volume: TsdfVolume, frame: Frame) -> Int[Tensor, "N 3"]:
    """Coordinates of all blocks that the band of any pixel's ray crosses, each once.

    The band is ``depth +- truncation`` along z (``sdf="z"``) or along the ray (``sdf="ray"``). Pixels outside
    ``near_m`` .. ``far_m`` and, with ``outlier_guard``, isolated ones take no part. The crossing is exact: no block is
    skipped at a corner, and no pixel is skipped.
    """
    config, camera = volume.config, frame.camera
    check_pose("T_WC", frame.T_WC)
    usable = (frame.depth_m > 0) & (frame.depth_m >= config.near_m) & (frame.depth_m <= config.far_m)
    if config.outlier_guard:
        usable &= has_support(frame.depth_m)
    pixel = usable.view(-1).nonzero()[:, 0]
    if not pixel.shape[0]:
        return torch.zeros(0, 3, dtype=torch.int64, device=frame.depth_m.device)
    rays = ray_slopes(camera, frame.depth_m)
    depth, x, y = (plane.reshape(-1).index_select(0, pixel) for plane in (frame.depth_m, *rays))
    ray_length = (x * x + y * y + 1.0).sqrt_()
    half = config.truncation_m / ray_length if config.sdf == "ray" else torch.full_like(depth, config.truncation_m)
    near, far = (depth - half).clamp_(min=0.0), depth + half

    box = block_box(volume, frame, float(near.amin()), float(far.amax()))
    pieces = box.pieces(float(((far - near) * ray_length).amax()))
    marked = _CellSet(box.size, depth.device)
    for i in range(0, depth.shape[0], _CHUNK_PX):
        part = slice(i, i + _CHUNK_PX)
        directions = [r[0] * x[part] + r[1] * y[part] + r[2] for r in box.R]
        _traverse(marked, box.origin, directions, (near[part], far[part]), pieces)
    return marked.cells() + box.low


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


def ray_slopes(camera: Camera, like: Float[Tensor, "H W"]) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """x / z and y / z of the ray through every pixel centre, as planes."""
    u = torch.arange(camera.width, device=like.device, dtype=like.dtype)
    v = torch.arange(camera.height, device=like.device, dtype=like.dtype)
    x = (u + (0.5 - camera.cx)) / camera.fx
    y = (v + (0.5 - camera.cy)) / camera.fy
    return x.expand_as(like), y[:, None].expand_as(like)


def has_support(depth_m: Float[Tensor, "H W"], ratio: float = OUTLIER_RATIO) -> Bool[Tensor, "H W"]:
    """Pixels with at least one of their eight neighbours within ``ratio`` of their own depth.

    A lone pixel at a wrong depth would otherwise allocate blocks in free space.
    """
    H, W = depth_m.shape
    support = torch.zeros(H, W, dtype=torch.bool, device=depth_m.device)
    tolerance = ratio * depth_m
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = (slice(0, H - dy), slice(max(0, -dx), W - max(0, dx)))
        b = (slice(dy, H), slice(max(0, dx), W - max(0, -dx)))
        gap = (depth_m[a] - depth_m[b]).abs_()
        support[a] |= gap < tolerance[a]
        support[b] |= gap < tolerance[b]
    return support


class _CellSet:
    """A set of cells of a box: one byte per cell, or for a huge box the sorted distinct numbers."""

    def __init__(self, size: list[int], device: torch.device):
        self.size = size
        self.strides = (size[1] * size[2], size[2], 1)
        n = size[0] * size[1] * size[2]
        self.bitmap = torch.zeros(n, dtype=torch.bool, device=device) if n <= _BITMAP_CELLS else None
        self.dtype = torch.float32 if n <= _BITMAP_CELLS else torch.float64
        self.parts: list[Tensor] = []

    def add(self, number: Tensor) -> None:
        if self.bitmap is None:
            self.parts.append(number.to(torch.int64).unique())
        else:
            self.bitmap.index_fill_(0, number.to(torch.int64), True)

    def cells(self) -> Int[Tensor, "N 3"]:
        number = torch.cat(self.parts).unique() if self.bitmap is None else self.bitmap.nonzero()[:, 0]
        _, ny, nz = self.size
        return torch.stack([number // (ny * nz), number // nz % ny, number % nz], dim=1)


def _traverse(
    marked: _CellSet, origin: list[float], directions: list[Tensor], interval: tuple[Tensor, Tensor], pieces: int
) -> None:
    """Mark every cell that the segments ``origin + z direction``, z in ``interval``, pass through.

    Each segment is cut into pieces of at most one cell's length, whose ends are at most one cell apart on every axis.
    """
    near, far = interval
    previous = None
    for k in range(pieces + 1):
        z = (far - near).mul_(k / pieces).add_(near)
        point = [(d * z).add_(o) for o, d in zip(origin, directions, strict=True)]
        cell = [p.floor() for p in point]
        marked.add(_number(marked, cell))
        if previous is not None:
            _mark_between(marked, previous, (point, cell))
        previous = (point, cell)


def _mark_between(marked: _CellSet, start: tuple[list, list], end: tuple[list, list]) -> None:
    """Mark the cells between the end cells of short pieces that cross into a diagonal neighbour.

    A piece that changes two or three coordinates does so one at a time. After the first crossing only that coordinate
    has changed; before the last one, all but that have. Those two cells are all there can be in between.
    """
    steps = [b - a for a, b in zip(start[1], end[1], strict=True)]
    diagonal = (steps[0].abs() + steps[1].abs() + steps[2].abs() > 1.5).nonzero()[:, 0]
    if not diagonal.shape[0]:
        return
    p0, cell, p1, step = (
        [a.index_select(0, diagonal) for a in arrays] for arrays in (start[0], start[1], end[0], steps)
    )
    # Where along the piece it crosses the wall towards its end; an unchanged coordinate never does.
    t = [(torch.maximum(c, c + s) - a) / (b - a) for a, b, c, s in zip(p0, p1, cell, step, strict=True)]
    entry = [ti.masked_fill(s == 0, 2.0) for ti, s in zip(t, step, strict=True)]
    leave = [ti.masked_fill(s == 0, -1.0) for ti, s in zip(t, step, strict=True)]
    first = torch.minimum(torch.minimum(entry[0], entry[1]), entry[2])
    last = torch.maximum(torch.maximum(leave[0], leave[1]), leave[2])
    marked.add(_number(marked, [c + s * (e == first) for c, s, e in zip(cell, step, entry, strict=True)]))
    marked.add(_number(marked, [c + s * (e != last) for c, s, e in zip(cell, step, leave, strict=True)]))


def _number(marked: _CellSet, cell: list[Tensor]) -> Tensor:
    sx, sy, _ = marked.strides
    x, y, z = (c.to(marked.dtype) for c in cell)
    return (x * sx).add_(y, alpha=sy).add_(z)
