"""Triangles of a mesh: their corners and areas, and how far a point is from one."""

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..checks import check_finite, check_shape
from ..resources import MAP_MEMORY
from ..types import Mesh

FACES_AT_A_TIME = 1 << 20
"""Limits the memory for intermediate results."""

Vectors = Sequence[Float[Tensor, "*N"]]
"""Vectors by component, which torch takes in whole registers; of rows of three it takes one number
at a time."""


def _difference(a: Vectors, b: Vectors) -> Vectors:
    return [p - q for p, q in zip(a, b, strict=True)]


def _dot(a: Vectors, b: Vectors) -> Float[Tensor, "*N"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vectors, b: Vectors) -> Vectors:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def point_triangle_distance(
    xyz: Float[Tensor, "*N 3"], triangle: Float[Tensor, "*N 3 3"]
) -> Float[Tensor, "*N"]:
    """Distance from a point to a filled triangle, metres.

    The foot of the perpendicular is used if it lies inside; otherwise the nearest point is on one
    of the three edges. A triangle without area counts as its longest edge.

    Differentiable: no.
    """
    a, b, c = triangle.unbind(-2)
    normal = torch.linalg.cross(b - a, c - a)
    x = xyz.unbind(-1)
    n = normal.unbind(-1)
    corners = [corner.unbind(-1) for corner in (a, b, c)]
    distance_2 = torch.full_like(x[0], math.inf)
    is_inside = _dot(n, n) > 0
    for p, q in zip(
        corners,
        corners[1:] + corners[:1],
        strict=True,
    ):
        edge = _difference(q, p)
        to_point = _difference(x, p)
        share = (_dot(to_point, edge) / _dot(edge, edge).clamp_min(1e-300)).clamp(0, 1)
        offset = _difference(
            x,
            [start + share * step for start, step in zip(p, edge, strict=True)],
        )
        distance_2 = torch.minimum(distance_2, _dot(offset, offset))
        is_inside = is_inside & (_dot(_cross(edge, to_point), n) >= 0)
    height = _dot(_difference(x, corners[0]), n).abs() / normal.norm(dim=-1).clamp_min(1e-300)
    return torch.where(is_inside, height, distance_2.sqrt())


def face_corners(
    mesh: Mesh,
    faces: Int[Tensor, " M"] | slice = slice(None),
) -> Float[Tensor, "M 3 3"]:
    """Corners of these faces, metres, float64."""
    return mesh.vertices_W[mesh.faces[faces].long()].double()


def measure_faces(
    mesh: Mesh, measure: Callable[[Float[Tensor, "M 3 3"]], Tensor], *width: int
) -> Tensor:
    """What ``measure`` gives for the corners of the faces, taken part by part to save memory."""
    check_shape("faces", mesh.faces, ("F", 3))
    check_finite("vertices_W", mesh.vertices_W)
    results = MAP_MEMORY.rows(
        len(mesh.faces), *width, dtype=torch.float64, device=mesh.faces.device
    )
    for start in range(0, len(mesh.faces), FACES_AT_A_TIME):
        part = slice(start, start + FACES_AT_A_TIME)
        results[part] = measure(face_corners(mesh, part))
        MAP_MEMORY.give_back()
    return results


def face_areas(mesh: Mesh) -> Float[Tensor, " F"]:
    """Area of each face, square metres."""
    return measure_faces(
        mesh,
        lambda x: torch.linalg.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]).norm(dim=1) / 2,
    )
