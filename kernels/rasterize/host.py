"""The output of the rasteriser before its kernels run, in numba and in CUDA."""

import torch

from gsfusion_nb.types import Camera, RenderOutput


def blank(camera: Camera, device: torch.device, *, with_indices: bool, with_hits: bool) -> RenderOutput:
    """An output that a kernel is to fill."""
    size = (camera.height, camera.width)
    rgb, depth_m, alpha = (torch.empty(*size, *n, dtype=torch.float32, device=device) for n in ((3,), (), ()))
    wanted = (with_indices, with_indices, with_hits)
    first, dominant, hit = (torch.empty(size, dtype=torch.int64, device=device) if w else None for w in wanted)
    return RenderOutput(
        rgb=rgb, depth_m=depth_m, alpha=alpha, first_index=first, dominant_index=dominant, hit_index=hit
    )
