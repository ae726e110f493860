"""An exercise of chapter 3: from a cell of the quadtree to a Gaussian."""

import math

import torch
from torch import Tensor

from ..geometry import se3
from ..seeding.quadtree import Cell, Cells
from ..types import Camera
from .exercise import Attempt, Becomes, Wrong, Yours, exercise


def _gaussian(
    camera: Camera,
    cell: Cell,
    depth_m: Tensor,
    T_WC: Tensor,
) -> tuple[Tensor, float]:
    x0, y0, w, h = cell
    u = x0 + w / 2
    v = y0 + h / 2
    z = depth_m[int(v), int(u)]
    xyz_C = torch.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
    return se3.apply(T_WC, xyz_C), float(z) * math.hypot(w / 2, h / 2) / camera.fx


def _gaussian_in_the_camera(
    camera: Camera, cell: Cell, depth_m: Tensor, T_WC: Tensor
) -> tuple[Tensor, float]:
    return _gaussian(camera, cell, depth_m, torch.eye(4))


def _gaussian_at_the_corner(
    camera: Camera, cell: Cell, depth_m: Tensor, T_WC: Tensor
) -> tuple[Tensor, float]:
    xyz_W, _ = _gaussian(
        camera,
        (cell[0], cell[1], 0, 0),
        depth_m,
        T_WC,
    )
    return xyz_W, _gaussian(camera, cell, depth_m, T_WC)[1]


def _gaussian_of_full_diagonal(
    camera: Camera, cell: Cell, depth_m: Tensor, T_WC: Tensor
) -> tuple[Tensor, float]:
    xyz_W, scale = _gaussian(camera, cell, depth_m, T_WC)
    return xyz_W, 2 * scale


def _gaussian_of_one_size(
    camera: Camera, cell: Cell, depth_m: Tensor, T_WC: Tensor
) -> tuple[Tensor, float]:
    return _gaussian(camera, cell, depth_m, T_WC)[0], math.hypot(
        cell[2] / 2, cell[3] / 2
    ) / camera.fx


def _as_cell_gaussians(
    yours: Yours, camera: Camera, cells: Cells, depth_m: Tensor, T_WC: Tensor
) -> tuple[Tensor, Tensor]:
    """Yours for every cell."""
    rows = zip(
        *(c.tolist() for c in (cells.x0, cells.y0, cells.width, cells.height)),
        strict=True,
    )
    like = {"xyz_W": T_WC.new_zeros(3), "scale_m": depth_m.new_zeros(())}
    calls = [(camera, cell, depth_m, T_WC) for cell in rows]
    results = yours.many(calls, [like] * len(calls))
    if not results:
        return T_WC.new_zeros(0, 3), depth_m.new_zeros(0)
    xyz_W, scale_m = (torch.stack(column) for column in zip(*results, strict=True))
    return xyz_W, scale_m


@exercise(
    chapter=3,
    difficulty=3,
    minutes=12,
    solution=_gaussian,
    becomes=Becomes("cell_gaussians", _as_cell_gaussians),
    hints=(
        "The middle of the cell, in continuous pixels, is (x0 + w / 2, y0 + h / 2).",
        "Depth z: that of the pixel which contains the middle. Lift the middle with it (chapter "
        "1), then apply T_WC.",
        "A length of r pixels at depth z is z r / fx metres. r is half the diagonal of the cell.",
    ),
    wrong=(
        Wrong(_gaussian_in_the_camera, says="world"),
        Wrong(_gaussian_at_the_corner, says="middle of the cell"),
        Wrong(_gaussian_of_full_diagonal, says="half the diagonal"),
        Wrong(_gaussian_of_one_size, says="twice as far"),
    ),
)
def cell_to_gaussian(attempt: Attempt) -> None:
    """Position and size of a cell's Gaussian (Eq. 10 and the size below it)."""
    camera = Camera(
        width=40,
        height=30,
        fx=20.0,
        fy=25.0,
        cx=20.0,
        cy=15.0,
    )
    names = ("xyz_W", "scale_m")
    case = "the cell (18, 11, 4, 8) around the image centre, depth 2 m, identity pose"
    flat = torch.full((30, 40), 2.0)
    xyz, scale = attempt.unpack(
        attempt.on(case)(camera, (18, 11, 4, 8), flat, torch.eye(4)),
        names,
    )
    attempt.close(
        xyz,
        [0.0, 0.0, 2.0],
        "seen from the world's origin, the Gaussian is on the ray through the middle of the cell",
    )
    attempt.on("the same cell on walls at 2 m and at 4 m")
    _, scale_far = attempt.unpack(
        attempt(camera, (18, 11, 4, 8), 2 * flat, torch.eye(4)),
        names,
    )
    prop = "on a wall twice as far the same cell is twice as large in metres"
    near, far = float(scale), float(scale_far)
    detail = f"got {near:.5g} m on the near wall and {far:.5g} m on the far one"
    attempt.holds(abs(far - 2 * near) <= 2e-4 * abs(near), prop, detail=detail)
    attempt.on(case).close(
        scale,
        2.0 * math.hypot(2, 4) / 20,
        "its standard deviation is half the diagonal, z r / fx",
        tolerance=1e-4,
    )
    attempt.on("a cell of odd size on a slanted wall, camera turned and moved")
    slope_m = 1.0 + 0.05 * torch.arange(40.0).expand(30, 40)
    T = se3.exp(torch.tensor([0.3, -0.2, 0.5, 0.4, -0.7, 0.2]))
    cell = (5, 7, 7, 5)
    reference = _gaussian(camera, cell, slope_m, T)
    xyz, scale = attempt.unpack(attempt(camera, cell, slope_m, T), names)
    prop = (
        "the position is in the world frame, with the depth of the middle pixel, fx for x and "
        "fy for y"
    )
    attempt.close(xyz, reference[0], prop, tolerance=1e-4)
    attempt.close(
        scale, reference[1], "the size uses the depth of the middle pixel", tolerance=1e-4
    )
