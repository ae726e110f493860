"""L1 loss of colour and depth with its gradient (RTG-SLAM).

Cases of ``rgbd_l1_vjp``: none, some and all pixels; missing depths; values that are equal.
"""

import functools
import itertools
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.optim import rgbd_l1_vjp

from . import Case


def cases() -> Iterator[Case]:
    """With and without the limit on depth behind the measurement."""
    for behind_m, share, size in itertools.product(
        (None, 0.1),
        (0.0, 0.3, 1.0),
        ((1, 1), (37, 53)),
    ):
        run = functools.partial(_loss, size, share, behind_m)
        name = f"behind_m={behind_m}, {size}, {share:.0%}"
        yield Case(name=name, operations=("rgbd_l1_vjp",), run=run)


def _loss(
    size: tuple[int, int], share: float, behind_m: float | None, device, dtype
) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(0)
    rgb, target_rgb = torch.rand(2, *size, 3, generator=g)
    depth_m, target_depth_m = (
        torch.rand(size, generator=g) * (torch.rand(size, generator=g) > 0.2) for _ in range(2)
    )
    if size[0] > 4:
        depth_m[3] = target_depth_m[3]
        rgb[4] = target_rgb[4]
    pixels = torch.rand(size, generator=g) < share
    images = (image.to(device, dtype) for image in (rgb, depth_m, target_rgb, target_depth_m))
    loss = rgbd_l1_vjp(
        *images, pixels.to(device), weight_colour=0.8, weight_depth=2.0, behind_m=behind_m
    )
    return vars(loss)
