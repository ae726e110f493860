"""The blocks that the band of a depth image crosses, entered into a hash set: ``allocate.cu``.

The host waits once, for the number of blocks.
"""

import ctypes
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from gsfusion_nb.tsdf.allocate import OUTLIER_RATIO
from gsfusion_nb.tsdf.allocate import band_blocks as reference
from gsfusion_nb.tsdf.morton import BITS, OFFSET
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Frame

from ..runtime.cuda.launch import device_of, launch
from ..runtime.gpu import check_dtype, packed, parts

_EDGE = 16
_FIRST_SLOTS, _MOST_SLOTS = 1 << 17, 1 << 26
"""Size of the hash set: a power of two, at most half full, eight times larger when it was too small."""


class Rays(NamedTuple):
    """Pixel (x, y) has the ray ((x + x_offset) / fx, (y + y_offset) / fy, 1)."""

    width: int
    height: int
    fx: float
    fy: float
    x_offset: float
    y_offset: float


class Limits(NamedTuple):
    """Which depths take part, the band around them, metres, and how both are decided."""

    near_m: float
    far_m: float
    truncation_m: float
    outlier_ratio: float
    guard: bool
    ray: bool


class View(NamedTuple):
    """Rows of R_WC, blocks per metre; the camera's centre in its own block; that block."""

    R: Annotated[list[float], ctypes.c_float * 9]
    origin: Annotated[list[float], ctypes.c_float * 3]
    base: Annotated[list[int], ctypes.c_int * 3]


class Set(NamedTuple):
    """The hash set, the list of its keys, the counts of both (``allocate.cu``), and their sizes."""

    table: Tensor
    list: Tensor
    count: Tensor
    mask: int
    room: int


def band_blocks(volume: TsdfVolume, frame: Frame) -> Tensor:
    """See ``gsfusion_nb.tsdf.band_blocks``. Blocks in the order of the reference."""
    device = device_of("band_blocks", volume=volume.D, depth_m=frame.depth_m)
    check_dtype("band_blocks", torch.float32, depth_m=frame.depth_m)
    config, camera, T = volume.config, frame.camera, frame.T_WC_cpu.double()
    position = T[:3, 3] / volume.block_size_m
    base = position.floor()
    if float(base.abs().max()) >= OFFSET:
        return reference.reference(volume, frame)
    depth_m = packed(frame.depth_m)
    view = View(
        R=(T[:3, :3] / volume.block_size_m).flatten().tolist(),
        origin=(position - base).tolist(),
        base=base.int().tolist(),
    )
    rays = Rays(
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        x_offset=0.5 - camera.cx,
        y_offset=0.5 - camera.cy,
    )
    limits = Limits(
        near_m=config.near_m,
        far_m=config.far_m,
        truncation_m=config.truncation_m,
        outlier_ratio=OUTLIER_RATIO,
        guard=config.outlier_guard,
        ray=config.sdf == "ray",
    )
    tiles = parts(camera.width, _EDGE), parts(camera.height, _EDGE)
    slots = _FIRST_SLOTS
    while slots <= _MOST_SLOTS:
        table = torch.full((slots,), -1, dtype=torch.int64, device=device)
        found = torch.empty(slots // 2, dtype=torch.int64, device=device)
        count = torch.zeros(2, dtype=torch.int32, device=device)
        entries = Set(table=table, list=found, count=count, mask=slots - 1, room=slots // 2)
        launch("band_blocks", "allocate:band_blocks", tiles, _EDGE**2, depth_m, rays, limits, view, entries)
        n, insufficient = count.tolist()
        if not insufficient:
            key = found[:n].sort().values
            mask = (1 << BITS) - 1
            return torch.stack([key >> (2 * BITS), key >> BITS & mask, key & mask], dim=1) - OFFSET
        slots *= 8
    return reference.reference(volume, frame)
