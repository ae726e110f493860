"""How far points are from other points, and from a mesh, by search trees on the CPU."""

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..resources import MAP_MEMORY
from ..types import Mesh
from .triangles import FACES_AT_A_TIME, face_corners, point_triangle_distance

if TYPE_CHECKING:
    from scipy.spatial import KDTree

NEIGHBOURS = 8
"""Number of nearby points whose triangles are tested for the nearest surface point; 8 covers the
triangles around a typical vertex."""
POINTS_AT_A_TIME = 2_000
"""Of those whose distances to triangles are found together: the intermediate results stay in the
cache."""
CELL_M = 0.1
"""Points are looked up by cells of this size, metres."""


def distance_to_points(
    xyz: Float[Tensor, "N 3"],
    points: Float[Tensor, "M 3"],
) -> Float[Tensor, " N"]:
    """Distance from each point to the nearest of ``points``, on the CPU."""
    xyz = xyz.cpu()
    order = _by_place(xyz)
    distance = torch.empty(len(xyz), dtype=torch.float64)
    distance[order] = torch.from_numpy(
        _tree(points.cpu()).query(xyz[order].numpy(), workers=torch.get_num_threads())[0]
    )
    return distance


def _tree(points: Float[Tensor, "M 3"]) -> "KDTree":
    """A search tree whose cells are halved in the middle: made in less than half the time, searched
    as fast."""
    from scipy.spatial import KDTree

    return KDTree(points.numpy(), balanced_tree=False, compact_nodes=False)


def _by_place(xyz: Float[Tensor, "N 3"]) -> Int[Tensor, " N"]:
    """An order of points in which neighbours are near each other: a tree is searched three times as
    fast in it."""
    if not len(xyz):
        return torch.zeros(0, dtype=torch.int64)
    cell = ((xyz - xyz.amin(0)) / CELL_M).long()
    n_cells = cell.amax(0) + 1
    return ((cell[:, 0] * n_cells[1] + cell[:, 1]) * n_cells[2] + cell[:, 2]).argsort()


def distance_to_mesh(xyz: Tensor, mesh: Mesh, samples: tuple[Tensor, Tensor]) -> Tensor:
    """Distance of each point to ``mesh``, found through its ``samples`` and centroids, some faces
    after others."""
    xyz = xyz.cpu()
    points = samples[0].cpu()
    of_face = samples[1].cpu()
    distance = distance_to_points(xyz, points)  # not more than this
    for start in range(0, len(mesh.faces), FACES_AT_A_TIME):
        corners = face_corners(mesh, slice(start, start + FACES_AT_A_TIME)).cpu()
        low = corners.amin((0, 1))
        high = corners.amax((0, 1))
        middle = corners.mean(1)
        rows_near = ((xyz - xyz.clamp(low, high)).norm(dim=1) <= distance).nonzero()[:, 0]
        if not len(rows_near):
            continue
        rows_near = rows_near[distance[rows_near].argsort()]  # those of a part have similar bounds
        extent = float((corners - middle[:, None]).norm(dim=2).max())
        in_part = (of_face >= start) & (of_face < start + len(corners))
        # samples represent large triangles, centroids those too small to have a sample
        tree = _tree(torch.cat([points[in_part], middle]))
        faces = torch.cat(
            [
                of_face[in_part] - start,
                torch.arange(len(corners)),
                torch.zeros(1, dtype=torch.int64),
            ]
        )
        k = min(NEIGHBOURS, tree.n)
        for rows in rows_near.split(20_000):
            rows = rows[_by_place(xyz[rows])]
            # a face whose middle is beyond is not nearer
            limit = 1.001 * (float(distance[rows].max()) + extent)
            # tree.n if there are fewer
            index = tree.query(
                xyz[rows].numpy(), k=k, distance_upper_bound=limit, workers=torch.get_num_threads()
            )[1]
            candidates = faces[torch.from_numpy(index).reshape(len(rows), k)]
            for some_rows, tried_faces in zip(
                rows.split(POINTS_AT_A_TIME), candidates.split(POINTS_AT_A_TIME), strict=True
            ):
                tried_distance = point_triangle_distance(
                    xyz[some_rows, None].expand(-1, k, 3), corners[tried_faces]
                ).amin(1)
                distance[some_rows] = torch.minimum(distance[some_rows], tried_distance)
        MAP_MEMORY.give_back()
    return distance
