"""A loss of the picture, its gradient and the squared error as shown (``picture_loss.cu``). The host does not wait."""

import torch
from torch import Tensor

from gsfusion_nb.optim import losses as reference

from ..runtime.arguments import packed, parts
from ..runtime.cuda.launch import device_of, launch

_BLOCK, _PER_THREAD = 256, 16
"""As in ``picture_loss.cu``."""


def l1_mse_vjp(rgb: Tensor, target: Tensor) -> reference.PictureLoss:
    """See ``gsfusion_nb.optim.l1_mse_vjp``."""
    if not _fits(rgb, target):
        return reference.l1_mse_vjp.reference(rgb, target)
    return _loss("l1_mse_vjp", "picture_loss:l1_pass", rgb, target, 1.0 / rgb.numel())


def l2_mse_vjp(rgb: Tensor, target: Tensor) -> reference.PictureLoss:
    """See ``gsfusion_nb.optim.l2_mse_vjp``."""
    if not _fits(rgb, target):
        return reference.l2_mse_vjp.reference(rgb, target)
    return _loss("l2_mse_vjp", "picture_loss:l2_pass", rgb, target, 2.0 / rgb.numel())


def _fits(rgb: Tensor, target: Tensor) -> bool:
    return rgb.dtype == torch.float32 and target.dtype == torch.float32 and 0 < rgb.numel() < 1 << 31


def _loss(name: str, kernel: str, rgb: Tensor, target: Tensor, scale: float) -> reference.PictureLoss:
    total, device = rgb.numel(), device_of(name, rgb=rgb, target=target)
    blocks = parts(total, _BLOCK * _PER_THREAD)
    v_rgb = torch.empty(rgb.shape, dtype=torch.float32, device=device)
    partial = torch.empty(blocks, 2, dtype=torch.float64, device=device)
    means = torch.empty(2, dtype=torch.float32, device=device)
    images = packed(rgb), packed(target), v_rgb
    launch(name, kernel, blocks, _BLOCK, *images, partial, total, scale)
    launch(name, "picture_loss:mean_errors", 1, _BLOCK, partial, means, blocks, total)
    return reference.PictureLoss(value=means[0], mse=means[1], v_rgb=v_rgb)
