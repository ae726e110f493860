"""March every ray to the surface, one ray a thread: ``raycast.cu``. The host waits for nothing."""

from typing import NamedTuple

import torch
from torch import Tensor

from gsfusion_nb.tsdf.raycast import CLOSE_VOXELS, REFINEMENTS, STEP, RaycastOutput
from gsfusion_nb.tsdf.raycast import raycast as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Camera

from ..runtime.arguments import lens_of, packed, parts
from ..runtime.cuda.launch import device_of, launch
from ..sample.cuda import Pool, Table

_BLOCK, _WARP = 128, 32
_TILE, _WIDE, _HIGH = 16, 16, 8
"""As in ``raycast.cu``."""

_INFINITE_BITS = 0x7F800000


class Lens(NamedTuple):
    """Where the camera is, its lens and the size of the picture."""

    T_WC: Tensor
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


class Sizes(NamedTuple):
    """Metres; the share of the stored distance that a ray advances; interpolations after the linear one."""

    voxel: float
    block: float
    truncation: float
    step: float
    close: float
    refinements: int


class Spans(NamedTuple):
    """Nearest and farthest depth of any block in each tile of pixels, as the bits of floats."""

    first: Tensor
    last: Tensor
    tiles_x: int
    tiles_y: int


class Images(NamedTuple):
    """To be written."""

    depth: Tensor
    normal: Tensor
    rgb: Tensor


def raycast(volume: TsdfVolume, camera: Camera, T_WC: Tensor) -> RaycastOutput:
    """See ``gsfusion_nb.tsdf.raycast``."""
    lookup = volume.index.table
    if volume.D.dtype != torch.float32 or (volume.n_blocks and lookup is None):
        return reference.reference(volume, camera, T_WC)
    device = device_of("raycast", volume=volume.D)
    H, W = camera.height, camera.width
    if lookup is None:
        depth, normal, rgb = (torch.zeros(H, W, *n, dtype=torch.float32, device=device) for n in ((), (3,), (3,)))
        return RaycastOutput(depth_m=depth, normal_W=normal, rgb=rgb)
    out = Images(*(torch.empty(H, W, *n, dtype=torch.float32, device=device) for n in ((), (3,), (3,))))
    config, (rows, _, size) = volume.config, lookup
    lens = Lens(
        T_WC=packed(T_WC.to(device, torch.float32)), **lens_of(camera)._asdict(), width=W, height=H
    )  # fmt: skip
    sizes = Sizes(
        voxel=float(config.voxel_size_m),
        block=float(volume.block_size_m),
        truncation=float(config.truncation_m),
        step=STEP,
        close=CLOSE_VOXELS * config.voxel_size_m,
        refinements=REFINEMENTS,
    )
    tiles_x, tiles_y = parts(W, _TILE), parts(H, _TILE)
    first = torch.full((tiles_x * tiles_y,), _INFINITE_BITS, dtype=torch.int32, device=device)
    spans = Spans(first=first, last=torch.zeros_like(first), tiles_x=tiles_x, tiles_y=tiles_y)
    n, coords = volume.n_blocks, volume.block_coords
    launch("raycast", "raycast:block_spans", parts(n * _WARP, _BLOCK), _BLOCK, coords, n, lens, sizes, spans)
    table = Table(rows=rows, low=volume.index.table_low, size=size)
    pool = Pool(D=volume.D, W=volume.W, planes=volume.rgb_planes, W_rgb=volume.W_rgb)
    blocks = parts(W, _WIDE) * parts(H, _HIGH)
    launch("raycast", "raycast:raycast", blocks, _BLOCK, table, pool, lens, sizes, spans, out)
    return RaycastOutput(depth_m=out.depth, normal_W=out.normal, rgb=out.rgb)
