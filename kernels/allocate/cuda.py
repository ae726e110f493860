"""The blocks that the band of a depth image crosses, entered into a hash set: ``allocate.cu``.

The host waits once, for the number of blocks (and for the pose, if that is not in its memory).
"""

import torch
from torch import Tensor

from gsfusion_nb.checks import check_pose
from gsfusion_nb.tsdf.allocate import OUTLIER_RATIO
from gsfusion_nb.tsdf.allocate import band_blocks as reference
from gsfusion_nb.tsdf.morton import BITS, OFFSET
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Frame

from ..runtime.cuda.launch import check_dtype, device_of, launch, packed, parts

_EDGE = 16
_FIRST_SLOTS, _MOST_SLOTS = 1 << 17, 1 << 26
"""Size of the hash set: a power of two, at most half full, eight times larger when it was too small."""


def band_blocks(volume: TsdfVolume, frame: Frame) -> Tensor:
    """See ``gsfusion_nb.tsdf.band_blocks``. Blocks in the order of the reference."""
    device = device_of("band_blocks", volume=volume.D, depth_m=frame.depth_m)
    check_dtype("band_blocks", torch.float32, depth_m=frame.depth_m)
    pose = frame.T_WC.detach().cpu()
    check_pose("T_WC", pose)
    config, camera, T = volume.config, frame.camera, pose.double()
    position = T[:3, 3] / volume.block_size_m
    base = position.floor()
    if float(base.abs().max()) >= OFFSET:
        return reference.reference(volume, frame)
    depth_m = packed(frame.depth_m)
    view = [*(T[:3, :3] / volume.block_size_m).flatten().tolist(), *(position - base).tolist(), *base.int().tolist()]
    slots = _FIRST_SLOTS
    while slots <= _MOST_SLOTS:
        table = torch.full((slots,), -1, dtype=torch.int64, device=device)
        found = torch.empty(slots // 2, dtype=torch.int64, device=device)
        count = torch.zeros(2, dtype=torch.int32, device=device)
        launch(
            "band_blocks", "allocate:band_blocks", (parts(camera.width, _EDGE), parts(camera.height, _EDGE)), _EDGE**2,
            depth_m, table, found, count, slots - 1, slots // 2, camera.width, camera.height, float(camera.fx),
            float(camera.fy), 0.5 - camera.cx, 0.5 - camera.cy, float(config.near_m), float(config.far_m),
            float(config.truncation_m), OUTLIER_RATIO, config.outlier_guard, config.sdf == "ray", *view,
        )  # fmt: skip
        n, insufficient = count.tolist()
        if not insufficient:
            key = found[:n].sort().values
            mask = (1 << BITS) - 1
            return torch.stack([key >> (2 * BITS), key >> BITS & mask, key & mask], dim=1) - OFFSET
        slots *= 8
    return reference.reference(volume, frame)
