"""The blocks that the band of a depth image crosses: sixteen rays at a time into a byte map of the
view's bounding box.

The rays, pieces and roundings are the reference's, so the set of blocks is the same to the last
one.

The blocks that a view can meet, numbered from a corner: what the numba kernels mark cells in.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Int
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.tsdf import NewBlocks
from gsfusion_nb.tsdf.allocate import OUTLIER_RATIO
from gsfusion_nb.tsdf.allocate import band_blocks as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Frame

from ..runtime.arguments import ray_slopes
from ..runtime.numba.launch import launching
from ..runtime.numba.simd import (
    absolute,
    any_lane,
    either,
    floor,
    load,
    mark,
    maximum,
    minimum,
    select,
    splat,
    sqrt,
    store,
    times,
    truncate,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockBox:
    """The blocks around a part of a view, and the view in their units, relative to them: exact far
    from the origin."""

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
    """All blocks that the view frustum of ``frame`` can meet between two depths, with one to spare
    on each side."""
    camera = frame.camera
    T_WC = frame.T_WC.double()
    position = T_WC[:3, 3] / volume.block_size_m
    base = position.floor()
    R = (T_WC[:3, :3] / volume.block_size_m).tolist()
    xs = ((0 - camera.cx) / camera.fx, (camera.width - camera.cx) / camera.fx)
    ys = ((0 - camera.cy) / camera.fy, (camera.height - camera.cy) / camera.fy)
    corners = [(x * z, y * z, z) for x in xs for y in ys for z in (z_near, z_far)]
    low = []
    size = []
    origin = []
    for o, (rx, ry, rz) in zip((position - base).tolist(), R, strict=True):
        depth_m = [o + rx * x + ry * y + rz * z for x, y, z in corners]
        low.append(math.floor(min(depth_m)) - 1)
        size.append(math.floor(max(depth_m)) + 2 - low[-1])
        origin.append(o - low[-1])
    lowest = base.to(torch.int64) + torch.tensor(low, dtype=torch.int64, device=base.device)
    return BlockBox(low=lowest, size=size, origin=origin, R=R, block_size_m=volume.block_size_m)


# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false


f32 = np.float32
_ZERO = f32(0.0)
_HALF = f32(0.5)
_ONE = f32(1.0)
_TWO = f32(2.0)
_INFINITE = f32(np.inf)
_MORE_THAN_ONE = f32(1.5)
_NOT_USED = f32(-1.0)
_ROWS = 16
"""Image rows of one parallel task."""

_MAP_CELLS = 1 << 24
"""Largest box marked in a byte map; float32 counts exactly up to here. The reference handles larger
ones."""


_NEAREST, _FARTHEST, _LONGEST = range(3)
"""Rows of what a task finds out about its bands: smallest near end, largest far end, greatest
length, metres."""


def band_blocks(volume: TsdfVolume, frame: Frame) -> Tensor:
    """See ``gsfusion_nb.tsdf.band_blocks``."""
    depth_m = frame.depth_m
    config = volume.config
    camera = frame.camera
    if depth_m.dtype != torch.float32 or depth_m.device.type != "cpu":
        return reference.reference(volume, frame)
    width = camera.width
    height = camera.height
    x, y = ray_slopes(camera)
    slopes = np.zeros(-(-width // 16) * 16, np.float32), y.numpy()
    slopes[0][:width] = x.numpy()
    limits = tuple(map(f32, (config.near_m, config.far_m, config.truncation_m, OUTLIER_RATIO)))
    along_ray = config.sdf == "ray"
    depth = np.empty((height, len(slopes[0])), np.float32)
    extents = np.empty((-(-height // _ROWS), 3, 16), np.float32)
    with launching():
        _usable(
            depth_m.detach().contiguous().numpy(),
            *slopes,
            limits,
            config.outlier_guard,
            along_ray,
            depth,
            extents,
        )
        z_near = float(extents[:, _NEAREST].min())
        z_far = float(extents[:, _FARTHEST].max())
        if z_far < 0:
            return torch.zeros(0, 3, dtype=torch.int64)
        box = block_box(volume, frame, z_near, z_far)
        if math.prod(box.size) > _MAP_CELLS:
            return reference.reference(volume, frame)
        view = np.array(box.R, np.float32), np.array(box.origin, np.float32)
        marks = np.zeros(math.prod(box.size) // 8 * 8 + 8, np.uint8)
        pieces = box.pieces(float(extents[:, _LONGEST].max()))
        _crossed(
            depth,
            slopes,
            f32(config.truncation_m),
            view,
            np.array(box.size),
            pieces,
            along_ray,
            marks,
        )
        cells = _cells(marks, np.array(box.size))
    return torch.from_numpy(cells) + box.low


def new_band_blocks(volume: TsdfVolume, frame: Frame) -> NewBlocks:
    """See ``gsfusion_nb.tsdf.new_band_blocks``."""
    return volume.index.missing(band_blocks(volume, frame))


@njit(inline="always")
def _band(d, x, y, truncation, along_ray):
    """Near and far end of the bands of sixteen pixels, and the lengths of their rays per metre of
    depth."""
    one = splat(_ONE)
    length = sqrt(times(x, x) + times(y, y) + one)
    half = truncation
    if along_ray:
        half = times(one / length, truncation)
    return maximum(d - half, splat(_ZERO)), d + half, length


@njit(parallel=True, cache=True, error_model="numpy")
def _usable(depth, x, y, limits, outlier_guard, along_ray, result, extents):
    """Depth in rows of full vectors, -1 where it takes no part.

    limits: which depths take part, metres; half the width of the band, metres; the largest
    difference between neighbours that support each other, as a share of the depth. extents: [tasks,
    3, 16], see ``_NEAREST``; the extreme of each lane.
    """
    height, width = depth.shape
    stride = result.shape[1]
    for task in prange(extents.shape[0]):
        first = task * _ROWS
        last = min(height, task * _ROWS + _ROWS)
        line = stride + 32
        lines = np.full((_ROWS + 2) * line, -np.float32(1e9), np.float32)
        for i in range(max(first - 1, 0), min(last + 1, height)):
            start = (i - first + 1) * line + 16
            for j in range(width):
                lines[start + j] = depth[i, j]
        nearest = splat(_INFINITE)
        farthest = splat(_NOT_USED)
        longest = farthest
        zero = splat(_ZERO)
        not_used = splat(_NOT_USED)
        near_m = splat(limits[0])
        far_m = splat(limits[1])
        truncation = splat(limits[2])
        ratio = splat(limits[3])
        for i in range(first, last):
            row = result[i]
            for j in range(0, stride, 16):
                at = (i - first + 1) * line + 16 + j
                d = load(lines, at)
                used = (d > zero) & (d >= near_m) & (far_m >= d)
                if outlier_guard:
                    tolerance = times(ratio, d)
                    support = zero > zero
                    for k in (-line - 1, -line, -line + 1, -1, 1, line - 1, line, line + 1):
                        support = either(support, absolute(d - load(lines, at + k)) < tolerance)
                    used = used & support
                start_z, end_z, length = _band(d, load(x, j), splat(y[i]), truncation, along_ray)
                nearest = minimum(nearest, select(used, start_z, nearest))
                farthest = maximum(farthest, select(used, end_z, not_used))
                longest = maximum(longest, select(used, times(end_z - start_z, length), not_used))
                store(row, j, select(used, d, not_used))
        store(extents[task, _NEAREST], 0, nearest)
        store(extents[task, _FARTHEST], 0, farthest)
        store(extents[task, _LONGEST], 0, longest)


@njit(parallel=True, cache=True, error_model="numpy")
def _crossed(depth, slopes, truncation, view, size, pieces, along_ray, marks):
    """Mark the cells of the box that the bands pass through. view: rows of R_WC, blocks per metre;
    the camera's centre, blocks from the corner of the box.

    Threads share the map: each only ever writes ones.
    """
    height, stride = depth.shape
    x, y = slopes
    R, origin = view
    n = size[0] * size[1] * size[2]
    for task in prange((height + _ROWS - 1) // _ROWS):
        zero = splat(_ZERO)
        nowhere = splat(f32(n))
        band = splat(truncation)
        ox = splat(origin[0])
        oy = splat(origin[1])
        oz = splat(origin[2])
        stride_x = splat(f32(size[1] * size[2]))
        stride_y = splat(f32(size[2]))
        for i in range(task * _ROWS, min(height, task * _ROWS + _ROWS)):
            row = depth[i]
            slope_y = splat(y[i])
            for j in range(0, stride, 16):
                d = load(row, j)
                used = d > zero
                if not any_lane(used):
                    continue
                sx = load(x, j)
                start_z, end_z, _ = _band(d, sx, slope_y, band, along_ray)
                dx = times(splat(R[0, 0]), sx) + times(splat(R[0, 1]), slope_y) + splat(R[0, 2])
                dy = times(splat(R[1, 0]), sx) + times(splat(R[1, 1]), slope_y) + splat(R[1, 2])
                dz = times(splat(R[2, 0]), sx) + times(splat(R[2, 1]), slope_y) + splat(R[2, 2])
                px = times(dx, start_z) + ox
                py = times(dy, start_z) + oy
                pz = times(dz, start_z) + oz
                cx = floor(px)
                cy = floor(py)
                cz = floor(pz)
                number = select(used, cx * stride_x + cy * stride_y + cz, nowhere)
                _mark(marks, number, nowhere)
                for k in range(1, pieces + 1):
                    z = times(end_z - start_z, splat(f32(k / pieces))) + start_z
                    qx = times(dx, z) + ox
                    qy = times(dy, z) + oy
                    qz = times(dz, z) + oz
                    ex = floor(qx)
                    ey = floor(qy)
                    ez = floor(qz)
                    number = select(used, ex * stride_x + ey * stride_y + ez, nowhere)
                    _mark(marks, number, nowhere)
                    mx = ex - cx
                    my = ey - cy
                    mz = ez - cz
                    diagonal = used & (
                        absolute(mx) + absolute(my) + absolute(mz) > splat(_MORE_THAN_ONE)
                    )
                    if any_lane(diagonal):
                        piece = ((px, py, pz), (qx, qy, qz))
                        _mark_between(
                            marks,
                            piece,
                            (cx, cy, cz),
                            (mx, my, mz),
                            diagonal,
                            (stride_x, stride_y),
                            nowhere,
                        )
                    px = qx
                    py = qy
                    pz = qz
                    cx = ex
                    cy = ey
                    cz = ez
    marks[n] = 0


@njit(cache=True, error_model="numpy")
def _mark_between(marks, piece, cell, step, diagonal, strides, nowhere):
    """Mark the cells that pieces pass between the cells of their ends, where these differ along
    more than one axis.

    As in the reference: the coordinate that changes first has done so, then all but the last.
    """
    (px, py, pz), (qx, qy, qz) = piece
    cx, cy, cz = cell
    mx, my, mz = step
    stride_x, stride_y = strides
    zero = splat(_ZERO)
    half = splat(_HALF)
    late = splat(_TWO)
    early = splat(_NOT_USED)
    tx = _wall(px, qx, cx, mx)
    ty = _wall(py, qy, cy, my)
    tz = _wall(pz, qz, cz, mz)
    stays_x = absolute(mx) < half
    stays_y = absolute(my) < half
    stays_z = absolute(mz) < half
    ux = select(stays_x, late, tx)
    uy = select(stays_y, late, ty)
    uz = select(stays_z, late, tz)
    entry = minimum(minimum(ux, uy), uz)
    kx = select(entry >= ux, mx, zero)
    ky = select(entry >= uy, my, zero)
    kz = select(entry >= uz, mz, zero)
    number = (cx + kx) * stride_x + (cy + ky) * stride_y + (cz + kz)
    _mark(marks, select(diagonal, number, nowhere), nowhere)
    ux = select(stays_x, early, tx)
    uy = select(stays_y, early, ty)
    uz = select(stays_z, early, tz)
    leave = maximum(maximum(ux, uy), uz)
    kx = select(leave > ux, mx, zero)
    ky = select(leave > uy, my, zero)
    kz = select(leave > uz, mz, zero)
    number = (cx + kx) * stride_x + (cy + ky) * stride_y + (cz + kz)
    _mark(marks, select(diagonal, number, nowhere), nowhere)


@njit(inline="always")
def _mark(marks, number, nowhere):
    mark(marks, truncate(minimum(maximum(number, splat(_ZERO)), nowhere)))


@njit(inline="always")
def _wall(start, end, cell, step):
    """Where along the piece a coordinate crosses the wall between its cells, as a part of its
    length."""
    return (maximum(cell, cell + step) - start) / (end - start)


@njit(cache=True, error_model="numpy")
def _cells(marks, size):
    """Coordinates of the marked cells, in order."""
    words = marks.view(np.uint64)
    count = 0
    for w in range(words.shape[0]):
        if words[w] != 0:
            for i in range(8 * w, 8 * w + 8):
                count += marks[i]
    cells = np.empty((count, 3), np.int64)
    k = 0
    for w in range(words.shape[0]):
        if words[w] != 0:
            for i in range(8 * w, 8 * w + 8):
                if marks[i]:
                    cells[k, 0] = i // (size[1] * size[2])
                    cells[k, 1] = i // size[2] % size[1]
                    cells[k, 2] = i % size[2]
                    k += 1
    return cells
