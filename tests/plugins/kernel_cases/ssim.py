"""D-SSIM loss with its gradient.

Cases of ``dssim_vjp``: pictures smaller and larger than the window.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.optim import dssim_vjp

from . import Case


def cases() -> Iterator[Case]:
    """One for all sizes."""
    # worst seen 3e-6 of the largest entry: E[x^2] - E[x]^2 cancels in float32, for the reference as
    # well
    yield Case(name="pictures of five sizes", operations=("dssim_vjp",), run=_run, tolerance=2e-5)


def _run(device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    results = {}
    for height, width in ((1, 1), (3, 5), (11, 16), (40, 33), (61, 95)):
        g = torch.Generator().manual_seed(0)
        target = torch.rand(height, width, 3, generator=g)
        rgb = (target + 0.2 * torch.randn(height, width, 3, generator=g)).clamp(0, 1)
        loss, v_rgb = dssim_vjp(
            rgb.to(device, dtype),
            target.to(device, dtype),
            0.7,
        )
        results |= {f"loss {height}x{width}": loss, f"v_rgb {height}x{width}": v_rgb}
    return results
