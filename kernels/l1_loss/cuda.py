"""L1 loss, its gradient and the squared error of the picture as shown: ``l1_loss.cu``. The host waits for nothing."""

import torch
from torch import Tensor

from gsfusion_nb.optim import losses as reference

from ..runtime.cuda.launch import device_of, launch
from ..runtime.gpu import packed, parts

_BLOCK, _PER_THREAD = 256, 16
"""As in ``l1_loss.cu``."""


def l1_mse_vjp(rgb: Tensor, target: Tensor) -> reference.L1Loss:
    """See ``gsfusion_nb.optim.l1_mse_vjp``."""
    total = rgb.numel()
    if rgb.dtype != torch.float32 or target.dtype != torch.float32 or not 0 < total < 1 << 31:
        return reference.l1_mse_vjp.reference(rgb, target)
    device = device_of("l1_mse_vjp", rgb=rgb, target=target)
    blocks = parts(total, _BLOCK * _PER_THREAD)
    v_rgb = torch.empty(rgb.shape, dtype=torch.float32, device=device)
    partial = torch.empty(blocks, 2, dtype=torch.float64, device=device)
    means = torch.empty(2, dtype=torch.float32, device=device)
    images = packed(rgb), packed(target), v_rgb
    launch("l1_mse_vjp", "l1_loss:l1_pass", blocks, _BLOCK, *images, partial, total, 1.0 / total)
    launch("l1_mse_vjp", "l1_loss:l1_means", 1, _BLOCK, partial, means, blocks, total)
    return reference.L1Loss(value=means[0], mse=means[1], v_rgb=v_rgb)
