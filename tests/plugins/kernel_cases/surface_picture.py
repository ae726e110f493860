"""The base of a picture: holes of a surface filled, half a picture enlarged.

Cases of ``surface_picture``: every way with holes, at the picture's size and at half of it, odd
sizes, no surface.
"""

import functools
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from gsfusion_nb.render import surface_picture

from . import Case


def cases() -> Iterator[Case]:
    """Sizes, then ways with holes."""
    for size, small in (
        ((24, 32), (24, 32)),
        ((24, 32), (12, 16)),
        ((23, 33), (12, 17)),
        ((1, 1), (1, 1)),
    ):
        yield _case(f"{size} from {small}", size, small)
    for holes in ("black", "gaussians"):
        yield _case(f"holes {holes}", (24, 32), (12, 16), holes=holes)
    yield _case("no holes", (24, 32), (12, 16), share=0.0)
    yield _case("no surface", (24, 32), (12, 16), share=1.0)


def _case(
    name: str,
    size: tuple[int, int],
    small: tuple[int, int],
    **options: Any,
) -> Case:
    run = functools.partial(_run, size, small, **options)
    return Case(
        name=name,
        operations=("surface_picture",),
        run=run,
        dtypes=(torch.float32,),
    )


def _run(
    size: tuple[int, int],
    small: tuple[int, int],
    device: torch.device,
    dtype: torch.dtype,
    *,
    holes: Any = "filled",
    share: float = 0.3,
) -> dict[str, Tensor]:
    """``share``: of the pixels that have no surface."""
    g = torch.Generator().manual_seed(2)
    rgb = torch.rand(*small, 3, generator=g)
    steps = torch.randint(1, 3, small, generator=g)
    known = torch.rand(small, generator=g) >= share
    depth_m = (steps + 0.01 * torch.rand(small, generator=g)) * known
    view = surface_picture(
        (rgb * known[..., None]).to(device, dtype),
        depth_m.to(device, dtype),
        size,
        holes,
        0.1,
    )
    return vars(view.base) | {"depth_everywhere_m": view.depth_everywhere_m}
