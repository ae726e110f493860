"""A loss of the picture, its gradient and the squared error as shown (``picture_loss.cu``). The
host does not wait."""

import torch
from torch import Tensor

from gsfusion_nb.backends import load
from gsfusion_nb.optim.losses import PictureLoss

from ..runtime.arguments import packed, parts
from ..runtime.cuda.launch import device_of, launch

_BLOCK = 256
_PER_THREAD = 16
"""As in ``picture_loss.cu``."""


def l1_mse_vjp(rgb: Tensor, target: Tensor) -> PictureLoss:
    """See ``gsfusion_nb.optim.l1_mse_vjp``."""
    return _loss("l1_mse_vjp", "picture_loss:l1_pass", rgb, target, 1.0)


def l2_mse_vjp(rgb: Tensor, target: Tensor) -> PictureLoss:
    """See ``gsfusion_nb.optim.l2_mse_vjp``."""
    return _loss("l2_mse_vjp", "picture_loss:l2_pass", rgb, target, 2.0)


def _loss(
    name: str,
    kernel: str,
    rgb: Tensor,
    target: Tensor,
    factor: float,
) -> PictureLoss:
    if rgb.dtype != torch.float32 or not 0 < rgb.numel() < 1 << 31:
        return load(name, "reference")(rgb, target)
    total = rgb.numel()
    device = device_of(name, rgb)
    blocks = parts(total, _BLOCK * _PER_THREAD)
    v_rgb = torch.empty(rgb.shape, dtype=torch.float32, device=device)
    partial = torch.empty(blocks, 2, dtype=torch.float64, device=device)
    means = torch.empty(2, dtype=torch.float32, device=device)
    images = packed(rgb), packed(target), v_rgb
    launch(name, kernel, blocks, _BLOCK, *images, partial, total, factor / total)
    launch(name, "picture_loss:mean_errors", 1, _BLOCK, partial, means, blocks, total)
    return PictureLoss(value=means[0], mse=means[1], v_rgb=v_rgb)
