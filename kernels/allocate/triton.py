"""The blocks that the band of a depth image crosses: every pixel's ray marks a byte map of the view's bounding box.

Rays, pieces and formulas are the reference's. The host waits twice: for the extent of the depth, which sizes the map,
and for the number of marked cells.
"""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportIndexIssue=false
# pyright: reportGeneralTypeIssues=false

import dataclasses
import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsfusion_nb.tsdf.allocate import OUTLIER_RATIO
from gsfusion_nb.tsdf.allocate import band_blocks as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Frame

from ..runtime.slopes import ray_slopes
from ..runtime.triton.launch import device_of, launch, parts
from ..runtime.triton.vectors import load3
from .block_box import block_box

_BLOCK = 256
_NEAREST, _FARTHEST, _LONGEST = (tl.constexpr(row) for row in range(3))
"""Rows of what a program finds out about its bands: smallest near end, largest far end, greatest length, metres."""

_ORIGIN = tl.constexpr(9)
"""Place of the origin in the view, behind the nine entries of R."""
_MAP_CELLS = 1 << 28
"""Largest box marked in a byte map. The reference handles larger ones."""


def band_blocks(volume: TsdfVolume, frame: Frame) -> Tensor:
    """See ``gsfusion_nb.tsdf.band_blocks``."""
    if frame.depth_m.dtype != torch.float32:
        return reference.reference(volume, frame)
    device = device_of("band_blocks", volume=volume.D, depth_m=frame.depth_m)
    config, camera = volume.config, frame.camera
    pose = frame.T_WC.detach().cpu()
    depth_m = frame.depth_m.detach().contiguous()
    total = depth_m.numel()
    programs = parts(total, _BLOCK)
    depth, extents = torch.empty_like(depth_m), torch.empty(3, programs, dtype=torch.float32, device=device)
    x_slope, y_slope = ray_slopes(camera, device)
    shared = {
        "depth": depth,
        "x_slope": x_slope,
        "y_slope": y_slope,
        "width": camera.width,
        "truncation": float(config.truncation_m),
        "RAY": config.sdf == "ray",
        "BLOCK": _BLOCK,
        "num_warps": 4,
    }
    launch(
        _usable,
        programs,
        device,
        depth_m=depth_m,
        extents=extents,
        height=camera.height,
        near_m=float(config.near_m),
        far_m=float(config.far_m),
        ratio=OUTLIER_RATIO,
        GUARD=config.outlier_guard,
        **shared,
    )
    nearest, farthest, longest = (extents[row.value] for row in (_NEAREST, _FARTHEST, _LONGEST))
    z_near, z_far, length = torch.stack([nearest.amin(), farthest.amax(), longest.amax()]).tolist()
    if z_far < 0:
        return torch.zeros(0, 3, dtype=torch.int64, device=device)
    box = block_box(volume, dataclasses.replace(frame, T_WC=pose), z_near, z_far)
    cells = math.prod(box.size)
    if cells > _MAP_CELLS:
        return reference.reference(volume, frame)
    view = torch.tensor([*(x for row in box.R for x in row), *box.origin], dtype=torch.float32).to(device)
    marks = torch.zeros(cells, dtype=torch.uint8, device=device)
    nx, ny, nz = box.size
    launch(
        _mark_bands,
        programs,
        device,
        view=view,
        marks=marks,
        total=total,
        pieces=box.pieces(length),
        nx=nx,
        ny=ny,
        nz=nz,
        **shared,
    )
    number = marks.nonzero()[:, 0]
    return torch.stack([number // (ny * nz), number // nz % ny, number % nz], dim=1) + box.low.to(device)


@triton.jit
def _band(d, x, y, truncation, RAY: tl.constexpr):
    """Near and far end of the bands of pixels, and the lengths of their rays per metre of depth."""
    length = tl.sqrt(x * x + y * y + 1.0)
    half = 0.0 * length + truncation
    if RAY:
        half = truncation / length
    return tl.maximum(d - half, 0.0), d + half, length


@triton.jit(do_not_specialize=["width", "height", "near_m", "far_m", "truncation", "ratio"])
def _usable(
    depth_m, x_slope, y_slope, depth, extents, width, height, near_m, far_m, truncation, ratio,
    GUARD: tl.constexpr, RAY: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Depth, -1 where it takes no part; ``extents`` [3, programs], see ``_NEAREST``."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = at < width * height
    i, j = at % width, at // width
    d = tl.load(depth_m + at, mask=here, other=0.0)
    used = here & (d > 0) & (d >= near_m) & (d <= far_m)
    if GUARD:
        support = used & (d < 0)
        for k in tl.static_range(9):
            if k != 4:
                x, y = i + (k % 3 - 1), j + (k // 3 - 1)
                beside = used & (x >= 0) & (x < width) & (y >= 0) & (y < height)
                other = tl.load(depth_m + y * width + x, mask=beside, other=float("inf"))
                support = support | (beside & (tl.abs(d - other) < ratio * d))
        used = used & support
    x, y = tl.load(x_slope + i, mask=here, other=0.0), tl.load(y_slope + j, mask=here, other=0.0)
    near, far, length = _band(d, x, y, truncation, RAY)
    tl.store(depth + at, tl.where(used, d, -1.0), mask=here)
    n, part = tl.num_programs(0), tl.program_id(0)
    tl.store(extents + _NEAREST * n + part, tl.min(tl.where(used, near, float("inf")), axis=0))
    tl.store(extents + _FARTHEST * n + part, tl.max(tl.where(used, far, -1.0), axis=0))
    tl.store(extents + _LONGEST * n + part, tl.max(tl.where(used, (far - near) * length, -1.0), axis=0))


@triton.jit
def _wall(start, end, cell, step):
    """Where along the piece a coordinate crosses the wall between its cells; only for one that does."""
    moved = step != 0
    return (tl.maximum(cell, cell + step) - start) / tl.where(moved, end - start, 1.0)


@triton.jit
def _mark(marks, x, y, z, ny, nz, mask):
    number = (x.to(tl.int32) * ny + y.to(tl.int32)) * nz + z.to(tl.int32)
    tl.store(marks + number, number * 0 + 1, mask=mask)


@triton.jit(do_not_specialize=["width", "total", "truncation", "pieces", "nx", "ny", "nz"])
def _mark_bands(
    depth, x_slope, y_slope, view, marks, width, total, truncation, pieces, nx, ny, nz,
    RAY: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Mark the cells that the bands pass through; ``view`` is R by rows, then the origin. All write ones."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    d = tl.load(depth + at, mask=at < total, other=-1.0)
    used = d > 0
    i, j = tl.where(used, at % width, 0), tl.where(used, at // width, 0)
    x, y = tl.load(x_slope + i), tl.load(y_slope + j)
    near, far, _ = _band(d, x, y, truncation, RAY)
    r0, r1, r2 = load3(view, 0, True)
    r3, r4, r5 = load3(view, 1, True)
    r6, r7, r8 = load3(view, 2, True)
    dx, dy, dz = r0 * x + r1 * y + r2, r3 * x + r4 * y + r5, r6 * x + r7 * y + r8
    ox, oy, oz = load3(view + _ORIGIN, 0, True)
    px, py, pz = dx * near + ox, dy * near + oy, dz * near + oz
    cx, cy, cz = tl.floor(px), tl.floor(py), tl.floor(pz)
    _mark(marks, cx, cy, cz, ny, nz, used)
    k = 0
    while k < pieces:
        k += 1
        z = (far - near) * ((k + 0.0) / pieces) + near
        qx, qy, qz = dx * z + ox, dy * z + oy, dz * z + oz
        ex, ey, ez = tl.floor(qx), tl.floor(qy), tl.floor(qz)
        _mark(marks, ex, ey, ez, ny, nz, used)
        mx, my, mz = ex - cx, ey - cy, ez - cz
        diagonal = used & (tl.abs(mx) + tl.abs(my) + tl.abs(mz) > 1.5)
        # as in the reference: the coordinate that changes first has done so, then all but the last
        tx, ty, tz = _wall(px, qx, cx, mx), _wall(py, qy, cy, my), _wall(pz, qz, cz, mz)
        ux, uy, uz = tl.where(mx == 0, 2.0, tx), tl.where(my == 0, 2.0, ty), tl.where(mz == 0, 2.0, tz)
        entry = tl.minimum(tl.minimum(ux, uy), uz)
        x1, y1 = cx + tl.where(ux == entry, mx, 0.0), cy + tl.where(uy == entry, my, 0.0)
        _mark(marks, x1, y1, cz + tl.where(uz == entry, mz, 0.0), ny, nz, diagonal)
        ux, uy, uz = tl.where(mx == 0, -1.0, tx), tl.where(my == 0, -1.0, ty), tl.where(mz == 0, -1.0, tz)
        leave = tl.maximum(tl.maximum(ux, uy), uz)
        x1, y1 = cx + tl.where(ux != leave, mx, 0.0), cy + tl.where(uy != leave, my, 0.0)
        _mark(marks, x1, y1, cz + tl.where(uz != leave, mz, 0.0), ny, nz, diagonal)
        px, py, pz, cx, cy, cz = qx, qy, qz, ex, ey, ez
