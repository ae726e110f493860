"""L1 loss, its gradient and the squared error of the picture as shown, in one pass. The host waits for nothing."""

# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportIndexIssue=false

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsfusion_nb.optim import losses as reference

from ..runtime.triton.launch import device_of, launch, parts

_BLOCK = 1024


def l1_mse_vjp(rgb: Tensor, target: Tensor) -> reference.L1Loss:
    """See ``gsfusion_nb.optim.l1_mse_vjp``."""
    if rgb.dtype != torch.float32 or target.dtype != torch.float32 or rgb.shape != target.shape:
        return reference.l1_mse_vjp.reference(rgb, target)
    device = device_of("l1_mse_vjp", rgb=rgb, target=target)
    total = rgb.numel()
    v_rgb = torch.empty(rgb.shape, dtype=torch.float32, device=device)
    sums = torch.empty(2, parts(total, _BLOCK), dtype=torch.float32, device=device)
    launch(
        _pass,
        sums.shape[1],
        device,
        rgb=rgb.detach().contiguous(),
        target=target.detach().contiguous(),
        v_rgb=v_rgb,
        sums=sums,
        total=total,
        scale=1.0 / max(total, 1),
        BLOCK=_BLOCK,
        num_warps=4,
    )
    value, mse = sums.sum(1, dtype=torch.float64).div_(total).float()
    return reference.L1Loss(value=value, mse=mse, v_rgb=v_rgb)


@triton.jit(do_not_specialize=["total", "scale"])
def _pass(rgb, target, v_rgb, sums, total, scale, BLOCK: tl.constexpr):
    """Sum |C - C^| of each program, then sum (clamp C^ - C)^2 of each."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < total
    shown, wanted = tl.load(rgb + i, mask=here, other=0.0), tl.load(target + i, mask=here, other=0.0)
    gap = shown - wanted
    tl.store(v_rgb + i, tl.where(gap > 0, scale, tl.where(gap < 0, -scale, 0.0)), mask=here)
    off = tl.minimum(tl.maximum(shown, 0.0), 1.0) - wanted
    tl.store(sums + tl.program_id(0), tl.sum(tl.abs(gap), axis=0))
    tl.store(sums + tl.num_programs(0) + tl.program_id(0), tl.sum(off * off, axis=0))
