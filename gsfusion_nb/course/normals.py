"""An exercise of chapter 1: normals of an image of points."""

import torch
from torch import Tensor

from ..geometry import depth_to_points
from ..types import Camera
from .exercise import Attempt, Wrong, exercise
from .frames import SMALL_CAMERA


def _normals(points: Tensor) -> Tensor:
    tangent_u = points[1:-1, 2:] - points[1:-1, :-2]
    tangent_v = points[2:, 1:-1] - points[:-2, 1:-1]
    n = torch.linalg.cross(tangent_v, tangent_u)
    return n / n.norm(dim=-1, keepdim=True)


def _normals_away(points: Tensor) -> Tensor:
    return -_normals(points)


def _normals_not_unit(points: Tensor) -> Tensor:
    tangent_u = points[1:-1, 2:] - points[1:-1, :-2]
    tangent_v = points[2:, 1:-1] - points[:-2, 1:-1]
    return torch.linalg.cross(tangent_v, tangent_u)


@exercise(
    chapter=1,
    difficulty=3,
    minutes=10,
    solution=_normals,
    hints=(
        "Two directions in the surface: from the left to the right neighbour, and from the upper "
        "to the lower one.",
        "Their cross product is normal to both. Which order points back at the camera, to negative "
        "z?",
        "torch.linalg.cross(down, across), divided by its length.",
    ),
    wrong=(
        Wrong(_normals_away, says="faces the camera"),
        Wrong(_normals_not_unit, says="length 1"),
    ),
)
def normals_of_points(attempt: Attempt) -> None:
    """Normals of an image of points, by central differences."""
    points = depth_to_points(SMALL_CAMERA, torch.full((6, 8), 2.0))
    n = attempt.on("a wall at z = 2 m, seen straight on")(points)
    attempt.close(
        torch.as_tensor(n).shape,
        [4, 6, 3],
        "the border has no normal: the result is [H - 2, W - 2, 3]",
    )
    n = torch.as_tensor(n)
    attempt.close(
        n.norm(dim=-1),
        torch.ones(4, 6),
        "a normal has length 1",
        tolerance=1e-4,
    )
    attempt.holds(
        (n[..., 2] < 0).all(),
        "the normal faces the camera: its z is negative",
        detail=f"z of the normal is {float(n[..., 2].max()):.3g}",
    )
    attempt.on("a floor 1 m below the camera")
    uv = torch.stack(
        torch.meshgrid(torch.arange(8) + 0.5, torch.arange(6) + 0.5, indexing="xy"),
        dim=-1,
    )
    camera = Camera(
        width=8,
        height=6,
        fx=10.0,
        fy=5.0,
        cx=4.0,
        cy=-3.0,
    )
    floor = depth_to_points(camera, camera.fy / (uv[..., 1] - camera.cy))
    vertical = torch.tensor([0.0, -1.0, 0.0]).expand(4, 6, 3)
    attempt.close(
        attempt(floor), vertical, "the floor's normal points up, to negative y", tolerance=1e-4
    )
    bowl = depth_to_points(
        SMALL_CAMERA,
        2 - 0.3 * (uv[..., 0] - 3) ** 2 / 16 - 0.2 * (uv[..., 1] - 2) ** 2 / 9,
    )
    prop = (
        "central differences: from the left to the right neighbour, and from the upper to the "
        "lower one"
    )
    attempt.close(
        attempt.on("a curved surface")(bowl),
        _normals(bowl),
        prop,
        tolerance=1e-4,
    )
