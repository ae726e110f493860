"""An exercise of chapter 3: a cell is cut until its Gaussian is small enough, in metres."""

import torch
from torch import Tensor

from ..seeding.quadtree import Cell, cut
from ..types import Camera
from .exercise import Attempt, Wrong, exercise
from .quadtree import as_cells

SMALLEST_HALF_PX = 1
"""A cell is cut only while half its width and half its height are above this."""


def _size_m(camera: Camera, cell: Cell, depth_m: Tensor) -> float:
    x0, y0, w, h = cell
    z = float(depth_m[int(y0 + h / 2), int(x0 + w / 2)])
    return z * (w**2 + h**2) ** 0.5 / 2 / camera.fx


def _parts(camera: Camera, cell: Cell, depth_m: Tensor, largest_m: float) -> list[Cell]:
    is_small = min(cell[2:]) // 2 <= SMALLEST_HALF_PX
    if is_small or _size_m(camera, cell, depth_m) <= largest_m:
        return [cell]
    return [leaf for part in cut(*cell) for leaf in _parts(camera, part, depth_m, largest_m)]


def _parts_after_one_cut(
    camera: Camera, cell: Cell, depth_m: Tensor, largest_m: float
) -> list[Cell]:
    return cut(*cell) if _size_m(camera, cell, depth_m) > largest_m else [cell]


def _parts_by_pixels(camera: Camera, cell: Cell, depth_m: Tensor, largest_m: float) -> list[Cell]:
    return _parts(camera, cell, torch.ones_like(depth_m), largest_m)


def _parts_by_the_first_depth(
    camera: Camera, cell: Cell, depth_m: Tensor, largest_m: float
) -> list[Cell]:
    x0, y0, w, h = cell
    first = depth_m[int(y0 + h / 2), int(x0 + w / 2)]
    return _parts(camera, cell, torch.full_like(depth_m, float(first)), largest_m)


def _parts_without_end(camera: Camera, cell: Cell, depth_m: Tensor, largest_m: float) -> list[Cell]:
    if min(cell[2:]) < 2 or _size_m(camera, cell, depth_m) <= largest_m:
        return [cell]
    return [
        leaf for part in cut(*cell) for leaf in _parts_without_end(camera, part, depth_m, largest_m)
    ]


@exercise(
    chapter=3,
    difficulty=3,
    minutes=10,
    solution=_parts,
    goes_on_with=("split_cell",),
    hints=(
        "A recursion as in 3.3: return [cell], or the parts of its four parts in one list.",
        "The size is that of 3.4, z r / fx, with the depth of the cell's own middle.",
        "Return [cell] where the size is at most largest_m, and also where w // 2 or h // 2 is 1.",
    ),
    wrong=(
        Wrong(_parts_by_pixels, says="twice as far"),
        Wrong(_parts_after_one_cut, says="again"),
        Wrong(_parts_by_the_first_depth, says="its own middle"),
        Wrong(_parts_without_end, says="half its width"),
    ),
)
def cells_of_size(attempt: Attempt) -> None:
    """A cell is cut until the Gaussian of each part is at most as large as a length in metres."""
    camera = Camera(
        width=64,
        height=48,
        fx=40.0,
        fy=60.0,
        cx=32.0,
        cy=24.0,
    )
    whole = (0, 0, 64, 48)  # 40 pixels from its middle to its corners
    near = torch.full((48, 64), 1.0)
    attempt.on("a wall at 1 m, the whole image as one cell: its Gaussian has 1 m; largest_m = 1.01")
    _same_cells(attempt, (camera, whole, near, 1.01), "a cell that is small enough stays")
    attempt.on("the same cell, largest_m = 0.99")
    _same_cells(attempt, (camera, whole, near, 0.99), "a cell that is too large is cut in four")
    attempt.on("the same cell on a wall at 2 m, largest_m = 1.01")
    prop = "on a wall twice as far the same cell is twice as large, so it is cut"
    _same_cells(attempt, (camera, whole, 2 * near, 1.01), prop)
    attempt.on("the wall at 1 m, largest_m = 0.26")
    _same_cells(attempt, (camera, whole, near, 0.26), "a part that is too large is cut again")
    attempt.on("a wall at 2 m that ends at the column 32, with a wall at 1 m beside it")
    step_m = near.clone()
    step_m[:, 32:] = 2.0
    prop = "each part is measured with the depth of its own middle"
    _same_cells(attempt, (camera, whole, step_m, 0.51), prop)
    attempt.on("a cell of 13 x 9 pixels, largest_m = 0.001")
    prop = "a cell is cut only while half its width and half its height are above 1 pixel"
    _same_cells(attempt, (camera, (3, 2, 13, 9), near, 0.001), prop)
    attempt.on("a cell whose middle has no depth")
    prop = "a cell whose middle has no depth stays as it is"
    _same_cells(attempt, (camera, whole, 0 * near, 0.1), prop)


def _same_cells(
    attempt: Attempt, arguments: tuple[Camera, Cell, Tensor, float], proposition: str
) -> None:
    """The student's cells of these arguments are the solution's, in any order."""
    got = sorted(as_cells(attempt, attempt(*arguments)))
    right = sorted(_parts(*arguments))
    attempt.holds(
        got == right, proposition, detail=f"got {len(got)} cells, and {len(right)} are right"
    )
