"""An exercise of chapter 9: a quadtree with a given number of cells, placed where they reduce the
error most."""

import heapq
from collections.abc import Callable

import torch
from jaxtyping import UInt8
from torch import Tensor

from .exercise import Attempt, Failed, Wrong, exercise

Leaf = tuple[int, int, int, int]


def _budget_cells(rgb_u8: UInt8[Tensor, "H W 3"], n_cells: int) -> list[Leaf]:
    """Cut the cell with the largest sum of squared differences from its mean, until there are
    ``n_cells``."""
    return _cut_worst(rgb_u8, n_cells, _squared_error_of(rgb_u8))


def _cut_worst(
    rgb_u8: Tensor, n_cells: int, error: Callable[[int, int, int, int], float]
) -> list[Leaf]:
    """Cut the cell (x, y, w, h) with the largest ``error`` in four, until there are ``n_cells``."""
    H, W = rgb_u8.shape[:2]
    heap = [(-error(0, 0, W, H), (0, 0, W, H))]
    leaves: list[Leaf] = []
    while heap and len(heap) + len(leaves) + 3 <= n_cells:
        _, (x, y, w, h) = heapq.heappop(heap)
        if w < 2 or h < 2:
            leaves.append((x, y, w, h))
            continue
        a = w // 2
        b = h // 2
        for part in (
            (x, y, a, b),
            (x, y + b, a, h - b),
            (x + a, y, w - a, b),
            (x + a, y + b, w - a, h - b),
        ):
            heapq.heappush(heap, (-error(*part), part))
    return leaves + [cell for _, cell in heap]


def _squared_error_of(rgb_u8: Tensor):
    """Sum over a cell's pixels and channels of (value - mean)^2, from integral images."""
    c = rgb_u8.double()
    table = torch.cat([c, c * c], dim=-1).cumsum(0).cumsum(1)
    table = torch.nn.functional.pad(table, (0, 0, 1, 0, 1, 0)).numpy()

    def error(x: int, y: int, w: int, h: int) -> float:
        s = table[y + h, x + w] - table[y, x + w] - table[y + h, x] + table[y, x]
        return float((s[3:] - s[:3] ** 2 / (w * h)).sum())

    return error


def _budget_by_mean(rgb_u8: Tensor, n_cells: int) -> list[Leaf]:
    """As the solution, but by the mean error of a pixel, which is the quadtree's contrast."""
    error = _squared_error_of(rgb_u8)
    return _cut_worst(
        rgb_u8,
        n_cells,
        lambda x, y, w, h: error(x, y, w, h) / (w * h),
    )


def _budget_overshooting(rgb_u8: Tensor, n_cells: int) -> list[Leaf]:
    return _budget_cells(rgb_u8, n_cells + 3)


@exercise(
    chapter=9,
    difficulty=4,
    minutes=25,
    solution=_budget_cells,
    hints=(
        "Keep the leaves in a heap, the one with the largest error on top: heapq with negative "
        "errors.",
        "The error of a cell is the SUM over its pixels and channels of (value - mean)^2, as in "
        "the PSNR of a picture with one colour per cell.",
        "Pop the worst, cut it in four (as in chapter 3), push the parts; each cut adds three "
        "cells. Stop before there would be more than n_cells.",
        "Two integral images, of c and of c^2, give the error of any cell in a few subtractions: "
        "sum c^2 - (sum c)^2 / pixels.",
    ),
    wrong=(
        Wrong(_budget_by_mean, says="sum of errors"),
        Wrong(_budget_overshooting, says="at most n_cells"),
    ),
)
def budget_cells(attempt: Attempt) -> None:
    """A quadtree with a given number of cells, placed where they reduce the error most."""
    halves = torch.zeros(16, 16, 3, dtype=torch.uint8)
    halves[:, 8:] = 255
    cells = _cells(
        attempt,
        attempt.on("an image of two halves, black and white, and 4 cells")(halves, 4),
        16,
        16,
    )
    attempt.holds(
        len(cells) <= 4, "there are at most n_cells cells", detail=f"there are {len(cells)}"
    )
    attempt.close(len(cells), 4, "one split gives four cells")
    attempt.on("a plain wall with a small bright pattern, 37 x 29, and 40 cells")
    image = _busy_corner()
    cells = _cells(attempt, attempt(image, 40), 37, 29)
    attempt.holds(
        len(cells) <= 40, "there are at most n_cells cells", detail=f"there are {len(cells)}"
    )
    attempt.holds(
        len(cells) >= 37,
        "the budget is used: three more cells would be too many",
        detail=f"{len(cells)} cells",
    )
    error = _squared_error_of(image)
    got, best = (sum(error(*c) for c in some) for some in (cells, _budget_cells(image, 40)))
    attempt.holds(
        got <= 1.02 * best,
        "the cell with the largest sum of errors is split next",
        detail=f"the remaining squared error is {got / best:.2f} times as large as it could be",
    )
    strip = torch.arange(0, 240, 10, dtype=torch.uint8).reshape(1, 8, 3)
    detail = "a cell lower than 2 pixels is a leaf, whatever its error"
    cells = _cells(
        attempt, attempt.on("a strip of 8 x 1 pixels, and 7 cells")(strip, 7), 8, 1, detail
    )
    attempt.holds(
        len(cells) == 1,
        "a cell narrower or lower than 2 pixels is not split",
        detail=f"{len(cells)} cells",
    )


def _cells(
    attempt: Attempt,
    value: object,
    width: int,
    height: int,
    why: str = "",
) -> list[Leaf]:
    """The student's cells, which must tile the image."""
    try:
        cells = [(int(x), int(y), int(w), int(h)) for x, y, w, h in value]  # pyright: ignore
    except (TypeError, ValueError):
        raise Failed(
            "it returns a list of (x0, y0, width, height)",
            attempt.words,
            f"it returned {value!r:.80}",
        ) from None
    hits = torch.zeros(height, width, dtype=torch.int64)
    for x, y, w, h in cells:
        hits[y : y + h, x : x + w] += 1
    attempt.holds(
        (hits == 1).all() and all(w > 0 and h > 0 for *_, w, h in cells),
        "the cells tile the image",
        detail=f"{int((hits != 1).sum())} pixels are in no cell or in several{why and f': {why}'}",
    )
    return cells


def _busy_corner() -> Tensor:
    """29 x 37: a slow gradient everywhere, and a few single bright pixels in a corner."""
    ramp = torch.linspace(60, 160, 37).expand(29, 37)[..., None].expand(-1, -1, 3).clone()
    generator = torch.Generator().manual_seed(1)
    ramp[2:9, 2:9] += 60 * torch.rand(7, 7, 3, generator=generator)
    return ramp.round().to(torch.uint8)
