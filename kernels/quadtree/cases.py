"""Cases of ``quadtree``: pictures from one pixel up, of odd sizes, with thin and strided ones among them."""

from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.seeding import quadtree

from ..runtime.cases import Case

_SIZES = ((1, 1), (1, 500), (500, 3), (4, 4), (5, 7), (64, 48), (97, 61), (160, 120))


def cases() -> Iterator[Case]:
    """One for each measure of contrast, and one for the smallest cell."""
    for contrast in ("released", "std"):

        def run(device: torch.device, dtype: torch.dtype, contrast=contrast) -> dict[str, Tensor]:
            leaves = {}
            for size in _SIZES:
                image = picture(*size).to(device)
                for threshold in (0.0, 1e-5, 1e-3, 0.1):
                    cells = quadtree(image, threshold=threshold, contrast=contrast)
                    leaves |= {f"{name} {size}, {threshold}": column for name, column in vars(cells).items()}
            return leaves

        yield Case(name=f"contrast {contrast!r}", operations=("quadtree",), run=run, dtypes=(torch.float32,))
    yield Case(
        name="smallest cells and strides", operations=("quadtree",), run=_smallest_cells, dtypes=(torch.float32,)
    )


def picture(width: int, height: int) -> Tensor:
    """Noise on the left, a gradient on the right. uint8 [H, W, 3]"""
    g = torch.Generator().manual_seed(0)
    noise = torch.randint(0, 256, (height, width, 3), generator=g, dtype=torch.uint8)
    ramp = torch.linspace(0, 255, width)[None, :, None].expand(height, width, 3).to(torch.uint8)
    return torch.where((torch.arange(width) < width // 2)[None, :, None], noise, ramp)


def _smallest_cells(device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    image, leaves = picture(123, 77).to(device), {}
    for view, strided in (("whole", image), ("every other row", image[::2, ::3])):
        for min_cell_px in (1, 2, 5, 1000):
            cells = quadtree(strided, threshold=1e-6, min_cell_px=min_cell_px)
            leaves |= {f"{name} {view}, {min_cell_px} px": column for name, column in vars(cells).items()}
    return leaves
