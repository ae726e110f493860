"""Mean absolute and squared difference of a picture, with the gradient.

Cases of ``l1_mse_vjp`` and ``l2_mse_vjp``: colours beyond 0..1, and some that are equal.
"""

import functools
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.optim import l1_mse_vjp, l2_mse_vjp

from . import Case


def cases() -> Iterator[Case]:
    """One for each layout of the picture."""
    for name, planes in (("rows of pixels", False), ("planes of channels", True)):
        run = functools.partial(_run, planes)
        yield Case(name=name, operations=("l1_mse_vjp", "l2_mse_vjp"), run=run)


def _run(
    planes: bool,
    device: torch.device,
    dtype: torch.dtype,
) -> dict[str, Tensor]:
    results = {}
    for height, width in ((1, 1), (37, 53), (240, 320)):
        g = torch.Generator().manual_seed(0)
        rgb = 1.4 * torch.rand(height, width, 3, generator=g) - 0.2
        target = torch.rand(height, width, 3, generator=g)
        rgb[-1, -1] = target[-1, -1]
        rgb = rgb.permute(2, 0, 1).contiguous().permute(1, 2, 0) if planes else rgb
        for loss in (l1_mse_vjp, l2_mse_vjp):
            found = loss(rgb.to(device, dtype), target.to(device, dtype))
            results |= {
                f"{loss.__name__}, {name} {height}x{width}": value
                for name, value in vars(found).items()
            }
    return results
