"""Image quadtree of GSFusion.

Cases of ``quadtree``: pictures from one pixel up, of odd sizes, thin and strided ones, and of one
colour.
"""

import functools
import itertools
from collections.abc import Iterator
from typing import Literal

import torch
from torch import Tensor

from gsfusion_nb.seeding import quadtree

from . import Case

_SIZES = ((1, 1), (1, 500), (500, 3), (4, 4), (5, 7), (64, 48), (97, 61), (160, 120))


def cases() -> Iterator[Case]:
    """One for each measure of contrast, and one for the smallest cell."""
    runs = {
        f"contrast {contrast!r}": functools.partial(_cells, contrast)
        for contrast in ("released", "std")
    }
    for name, run in (runs | {"smallest cells and strides": _smallest_cells}).items():
        yield Case(
            name=name,
            operations=("quadtree",),
            run=run,
            dtypes=(torch.float32,),
        )


def _cells(
    contrast: Literal["released", "std"], device: torch.device, dtype: torch.dtype
) -> dict[str, Tensor]:
    leaves = {}
    for size, make, threshold in itertools.product(
        _SIZES, (noise_and_ramp, landscape), (0.0, 1e-3, 0.02)
    ):
        cells = quadtree(make(*size).to(device), threshold=threshold, contrast=contrast)
        picture = f"{make.__name__} {size}, {threshold}"
        leaves |= {f"{name} {picture}": column for name, column in vars(cells).items()}
    return leaves


def noise_and_ramp(width: int, height: int) -> Tensor:
    """Noise on the left, a gradient on the right. uint8 [H, W, 3]"""
    g = torch.Generator().manual_seed(0)
    noise = torch.randint(
        0,
        256,
        (height, width, 3),
        generator=g,
        dtype=torch.uint8,
    )
    ramp = torch.linspace(0, 255, width)[None, :, None].expand(height, width, 3).to(torch.uint8)
    return torch.where(
        (torch.arange(width) < width // 2)[None, :, None],
        noise,
        ramp,
    )


def landscape(width: int, height: int) -> Tensor:
    """Smooth regions, soft edges and one textured patch: cells of many sizes. uint8 [H, W, 3]"""
    v, u = torch.meshgrid(
        torch.arange(height),
        torch.arange(width),
        indexing="ij",
    )
    x = u / max(width, height)
    y = v / max(width, height)
    grey = 120 + 90 * torch.tanh(20 * (y - 0.3 - 0.1 * torch.sin(9 * x)))
    patch = ((x - 0.6) ** 2 + (y - 0.5) ** 2 < 0.02).float()
    texture = 30 * torch.sin(300 * x) * torch.sin(200 * y) * patch
    return (
        torch.stack(
            [grey + texture, 0.8 * grey, 200 - 0.5 * grey + texture],
            dim=-1,
        )
        .clamp(0, 255)
        .to(torch.uint8)
    )


def _smallest_cells(device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    image = noise_and_ramp(123, 77).to(device)
    leaves = {}
    views = {
        "whole": image,
        "every second row": image[::2, ::3],
        "planes": image.permute(2, 0, 1).contiguous().permute(1, 2, 0),
    }
    for view, strided in views.items():
        for min_cell_px in (1, 2, 5, 1000):
            cells = quadtree(strided, threshold=1e-6, min_cell_px=min_cell_px)
            leaves |= {
                f"{name} {view}, {min_cell_px} px": column for name, column in vars(cells).items()
            }
    for value in (0, 137, 255):
        cells = quadtree(
            torch.full((40, 60, 3), value, dtype=torch.uint8, device=device),
            threshold=0.0,
        )
        leaves |= {f"{name} of one colour, {value}": column for name, column in vars(cells).items()}
    return leaves
