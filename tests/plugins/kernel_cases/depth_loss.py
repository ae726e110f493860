"""Loss of a picture's depth over its alpha, with the gradient.

Cases of ``expected_depth_loss``: missing depth, pixels that are hardly covered or not at all, a
depth that is met, and no measured depth.
"""

import functools
import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.optim import expected_depth_loss

from . import Case


def cases() -> Iterator[Case]:
    """With and without the term for holes."""
    for coverage in (0.0, 0.3):
        for size in ((1, 1), (37, 53)):
            run = functools.partial(_loss, size, coverage, 0.8)
            yield Case(name=f"{size}, {coverage}", operations=("expected_depth_loss",), run=run)
    far = functools.partial(_loss, (37, 53), 0.3, 0.8, far_m=1.5)
    yield Case(name="some are far", operations=("expected_depth_loss",), run=far)
    none = functools.partial(_loss, (5, 7), 0.1, 0.0)
    yield Case(name="nothing measured", operations=("expected_depth_loss",), run=none)


def _loss(
    size: tuple[int, int],
    coverage: float,
    measured: float,
    device: torch.device,
    dtype: torch.dtype,
    far_m: float = math.inf,
) -> dict[str, Tensor]:
    """``measured``: share of the pixels with measured depth."""
    g = torch.Generator().manual_seed(0)
    depth_m, target_m, alpha = 3 * torch.rand(3, *size, generator=g)
    alpha = (alpha / 2).clamp(0, 1)
    target_m = target_m * (torch.rand(size, generator=g) < measured)
    if size[0] > 4:
        alpha[3] = 1.0
        depth_m[3] = target_m[3]
        alpha[4] = 0.0
        depth_m[4] = 0.0
    images = (image.to(device, dtype) for image in (depth_m, alpha, target_m))
    return vars(expected_depth_loss(*images, coverage, far_m, 0.7))
