"""March every ray to the surface, one ray a thread: ``raycast.cu``. The host waits for nothing."""

import torch
from torch import Tensor

from gsfusion_nb.tsdf.raycast import CLOSE_VOXELS, REFINEMENTS, STEP, RaycastOutput
from gsfusion_nb.tsdf.raycast import raycast as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Camera

from ..integrate.cuda import voxels_of
from ..runtime.arguments import lens_of, packed, parts
from ..runtime.cuda.launch import device_of, launch
from ..sample.cuda import table_of

_BLOCK = 128
_WARP = 32
_TILE = 16
_WIDE = 16
_HIGH = 8
"""As in ``raycast.cu``."""

_INFINITE_BITS = 0x7F800000


def raycast(volume: TsdfVolume, camera: Camera, T_WC: Tensor) -> RaycastOutput:
    """See ``gsfusion_nb.tsdf.raycast``."""
    device = volume.device
    n = volume.n_blocks
    coords = volume.block_coords
    if volume.D.dtype != torch.float32 or volume.index.table is None:
        return reference.reference(volume, camera, T_WC)
    device_of("raycast", volume.D)
    H = camera.height
    W = camera.width
    config = volume.config
    depth, normal, rgb = (
        (torch.empty if n else torch.zeros)(H, W, *k, device=device) for k in ((), (3,), (3,))
    )
    out = RaycastOutput(depth_m=depth, normal_W=normal, rgb=rgb)
    if not n:
        return out
    lens = lens_of(camera)._asdict() | {
        "T_WC": packed(T_WC.to(device, torch.float32)),
        "width": W,
        "height": H,
    }
    sizes = {
        "voxel": config.voxel_size_m,
        "block": volume.block_size_m,
        "truncation": config.truncation_m,
        "step": STEP,
        "close": CLOSE_VOXELS * config.voxel_size_m,
        "refinements": REFINEMENTS,
    }
    tiles_x = parts(W, _TILE)
    tiles_y = parts(H, _TILE)
    first = torch.full((tiles_x * tiles_y,), _INFINITE_BITS, dtype=torch.int32, device=device)
    spans = {
        "first": first,
        "last": torch.zeros_like(first),
        "tiles_x": tiles_x,
        "tiles_y": tiles_y,
    }
    launch(
        "raycast",
        "raycast:block_spans",
        parts(n * _WARP, _BLOCK),
        _BLOCK,
        coords,
        n,
        lens,
        sizes,
        spans,
    )
    blocks = parts(W, _WIDE) * parts(H, _HIGH)
    images = {"depth": depth, "normal": normal, "rgb": rgb}
    values = table_of(volume), voxels_of(volume)
    launch("raycast", "raycast:raycast", blocks, _BLOCK, *values, lens, sizes, spans, images)
    return out
