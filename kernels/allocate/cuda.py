"""The blocks that the band of a depth image crosses, entered into a hash set, and those of them
that are new: ``allocate.cu``. The host waits once, for their number.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfusion_nb import tsdf
from gsfusion_nb.tsdf import NewBlocks, TsdfVolume
from gsfusion_nb.tsdf.allocate import OUTLIER_RATIO
from gsfusion_nb.tsdf.morton import BITS, OFFSET
from gsfusion_nb.types import Frame

from ..runtime.arguments import check_dtype, packed, parts
from ..runtime.cuda.launch import device_of, launch
from ..sample.cuda import table_of

_EDGE = 16
_BLOCK = 128
_PROGRAMS = 64
_WIDE_BLOCK = 256
"""Blocks of threads that look for missing blocks among the keys, whose number only the GPU knows,
and their size."""
_KEYS = 0
_INSUFFICIENT = 1
_MISSING = 2
_LOWEST = 3
_HIGHEST = 6
_COUNTS = 9
"""Places of the counts; as in ``allocate.cu``."""
_FIRST_SLOTS = 1 << 17
_MOST_SLOTS = 1 << 26
"""Size of the hash set: a power of two, at most half full, eight times larger when it was too
small."""


def band_blocks(volume: TsdfVolume, frame: Frame) -> Tensor:
    """See ``gsfusion_nb.tsdf.band_blocks``. Blocks in the order of the reference."""
    found = _entered("band_blocks", volume, frame)
    if found is None:
        return tsdf.band_blocks.reference(volume, frame)
    entries, counts = found
    key = entries["list"][: counts[_KEYS]].sort().values
    mask = (1 << BITS) - 1
    return torch.stack([key >> (2 * BITS), key >> BITS & mask, key & mask], dim=1) - OFFSET


def new_band_blocks(volume: TsdfVolume, frame: Frame) -> NewBlocks:
    """See ``gsfusion_nb.tsdf.new_band_blocks``. A map that is too large for a table is searched by
    torch."""
    if volume.index.table is None:
        return volume.index.missing(band_blocks(volume, frame))
    found = _entered("new_band_blocks", volume, frame, table_of(volume))
    if found is None:
        return tsdf.new_band_blocks.reference(volume, frame)
    entries, counts = found
    n = counts[_MISSING]
    codes = entries["codes"][:n].sort().values
    coords = torch.empty(n, 3, dtype=torch.int64, device=codes.device)
    launch("new_band_blocks", "allocate:decode_blocks", parts(n, _BLOCK), _BLOCK, codes, coords, n)
    low = [OFFSET - 1 - number for number in counts[_LOWEST:_HIGHEST]]
    high = [number - OFFSET for number in counts[_HIGHEST:]]
    return NewBlocks(
        coords=coords, codes=codes, low=(low[0], low[1], low[2]), high=(high[0], high[1], high[2])
    )


def _entered(
    operation: str, volume: TsdfVolume, frame: Frame, table: dict[str, Any] | None = None
) -> tuple[dict[str, Any], list[int]] | None:
    """The blocks of the band and the counts; with a table also those that it lacks. None if no set
    is large enough."""
    device = device_of(operation, volume.D)
    check_dtype(operation, torch.float32, depth_m=frame.depth_m)
    config = volume.config
    camera = frame.camera
    T = frame.T_WC_cpu.double().numpy()
    position = T[:3, 3] / volume.block_size_m
    base = np.floor(position)
    if np.abs(base).max() >= OFFSET:
        return None
    depth_m = packed(frame.depth_m)
    view = {"R": (T[:3, :3] / volume.block_size_m).flatten().tolist()}  # blocks per metre
    view |= {"origin": (position - base).tolist(), "base": base.astype(int).tolist()}
    rays = {"width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy}
    rays |= {"x_offset": 0.5 - camera.cx, "y_offset": 0.5 - camera.cy}
    limits = {"near_m": config.near_m, "far_m": config.far_m, "truncation_m": config.truncation_m}
    limits |= {
        "outlier_ratio": OUTLIER_RATIO,
        "guard": config.outlier_guard,
        "ray": config.sdf == "ray",
    }
    tiles = parts(camera.width, _EDGE), parts(camera.height, _EDGE)
    slots = _FIRST_SLOTS
    while slots <= _MOST_SLOTS:
        marks = torch.full((slots,), -1, dtype=torch.int64, device=device)
        keys, codes = torch.empty(2, slots // 2, dtype=torch.int64, device=device)
        count = torch.zeros(_COUNTS, dtype=torch.int32, device=device)
        entries = {
            "table": marks,
            "list": keys,
            "codes": codes,
            "count": count,
            "mask": slots - 1,
            "room": slots // 2,
        }
        launch(
            operation, "allocate:band_blocks", tiles, _EDGE**2, depth_m, rays, limits, view, entries
        )
        if table is not None:
            launch(operation, "allocate:missing_blocks", _PROGRAMS, _WIDE_BLOCK, entries, table)
        counts = count.tolist()
        if not counts[_INSUFFICIENT]:
            return entries, counts
        slots *= 8
    return None
