"""The triangle table of marching cubes, derived from the topology of the cube instead of typed in.

Corner c of a cube is at (c & 1, c >> 1 & 1, c >> 2 & 1). An edge is named by its axis and its lower corner. A case is
the set of corners inside the surface (negative), one bit each. On every face of the cube each run of inside corners is
cut off by one segment; the rule looks at the face alone, so the two cubes that share a face agree on it, also where
its corners alternate, and the surface has no cracks. The segments join into closed loops, which are then triangulated.
"""

import functools

import torch
from torch import Tensor

EDGES = tuple((axis, corner) for axis in range(3) for corner in range(8) if not corner >> axis & 1)
"""(axis, lower corner) of the twelve edges; the edge joins the lower corner with lower corner + 2^axis."""

Loop = tuple[int, ...]
Triangle = tuple[int, int, int]


def _faces() -> list[list[int]]:
    """Corners of the six faces, counter-clockwise seen from outside the cube."""
    faces = []
    for axis in range(3):
        b, c = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        square = [0, b, b | c, c]
        faces += [square[::-1], [corner | 1 << axis for corner in square]]
    return faces


_FACES = _faces()


def _edge_between(a: int, b: int) -> int:
    return EDGES.index(((a ^ b).bit_length() - 1, min(a, b)))


_EDGES_OF_FACE = [{_edge_between(a, b) for a, b in zip(f, f[1:] + f[:1], strict=True)} for f in _FACES]


def loops(case: int) -> list[Loop]:
    """Closed polygons of cut edges that separate inside from outside, counter-clockwise seen from outside."""
    follows = {}
    for face in _FACES:
        for i in range(4):
            before, start = face[i - 1], face[i]
            if case >> before & 1 or not case >> start & 1:
                continue
            end = i
            while case >> face[(end + 1) % 4] & 1:
                end += 1
            # The run of inside corners from `start` to `end` is cut off: in through one edge, out through another.
            follows[_edge_between(before, start)] = _edge_between(face[end % 4], face[(end + 1) % 4])
    found = []
    while follows:
        loop = [min(follows)]
        while (edge := follows.pop(loop[-1])) != loop[0]:
            loop.append(edge)
        found.append(tuple(loop))
    return found


def triangulate(loop: Loop) -> list[Triangle]:
    """Triangles over a loop, without diagonals that lie in a face of the cube where that is possible.

    Such a diagonal could coincide with one of the neighbouring cube, and four triangles would then share it.
    """
    return min(_triangulations(loop), key=lambda triangles: sum(map(_diagonals_in_faces, triangles)))


def _triangulations(polygon: Loop) -> list[list[Triangle]]:
    """All ways to cut a polygon into triangles: choose the apex over its last side, then cut the two other parts."""
    if len(polygon) < 3:
        return [[]]
    found = []
    for k in range(1, len(polygon) - 1):
        for left in _triangulations(polygon[: k + 1]):
            for right in _triangulations(polygon[k:]):
                found.append([*left, (polygon[0], polygon[k], polygon[-1]), *right])
    return found


def _diagonals_in_faces(triangle: Triangle) -> int:
    """Sides of a triangle that lie in a face. The loop's own sides all do, so only the diagonals make a difference."""
    sides = ((triangle[0], triangle[1]), (triangle[1], triangle[2]), (triangle[2], triangle[0]))
    return sum(any(a in face and b in face for face in _EDGES_OF_FACE) for a, b in sides)


@functools.cache
def triangle_table() -> tuple[Tensor, Tensor]:
    """Edge numbers of the triangles of every case, padded with 0 [256, T, 3], and the number of triangles [256]."""
    cases = [[t for loop in loops(case) for t in triangulate(loop)] for case in range(256)]
    count = torch.tensor([len(triangles) for triangles in cases])
    table = torch.zeros(256, int(count.max()), 3, dtype=torch.int64)
    for case, triangles in enumerate(cases):
        if triangles:
            table[case, : len(triangles)] = torch.tensor(triangles)
    return table, count
