"""Fewer triangles for a picture: vertices that share a cell of a grid become one."""

import torch
from jaxtyping import Float
from torch import Tensor

from ...types import Mesh

_TRIALS = 8


def decimated(mesh: Mesh, max_triangles: int) -> Mesh:
    """The mesh with at most ``max_triangles``, by vertex clustering (Rossignac & Borrel 1993).

    The cell size follows from the surface's area and is widened until the count fits. Position and colour of a cluster
    are the means of its vertices. Evenly sized triangles keep colours better than fewer triangles on flat walls would.

    Args:
        mesh: Any mesh; returned as it is when small enough.
        max_triangles: Limit, >= 1.
    """
    if max_triangles < 1:
        raise ValueError(f"max_triangles must be >= 1, got {max_triangles}")
    if len(mesh.faces) <= max_triangles:
        return mesh
    corners = mesh.vertices_W[mesh.faces]
    area_m2 = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1).sum() / 2
    cell_m = float((2 * area_m2 / max_triangles).sqrt().clamp_min(1e-9))  # a grid of squares has two triangles in each
    for _ in range(_TRIALS):
        smaller = _clustered(mesh, cell_m)
        if len(smaller.faces) <= max_triangles:
            return smaller
        cell_m *= 1.05 * (len(smaller.faces) / max_triangles) ** 0.5
    return smaller if len(smaller.faces) <= max_triangles else _first(smaller, max_triangles)


def _clustered(mesh: Mesh, cell_m: float) -> Mesh:
    low = mesh.vertices_W.amin(0)
    key = ((mesh.vertices_W - low) / cell_m).floor().to(torch.int64)
    span = key.amax(0) + 1
    _, cluster = torch.unique((key[:, 0] * span[1] + key[:, 1]) * span[2] + key[:, 2], return_inverse=True)
    n = int(cluster.max()) + 1
    count = torch.bincount(cluster, minlength=n)[:, None]

    def mean(values: Float[Tensor, "V 3"]) -> Float[Tensor, "N 3"]:
        return values.new_zeros(n, 3).index_add_(0, cluster, values) / count

    faces = cluster[mesh.faces]
    a, b, c = faces.unbind(1)
    faces = faces[(a != b) & (b != c) & (c != a)]
    first = faces.argmin(1, keepdim=True)
    turned = faces.gather(1, (first + torch.arange(3, device=faces.device)) % 3)  # same triangle, same row
    return Mesh(vertices_W=mean(mesh.vertices_W), faces=torch.unique(turned, dim=0), rgb=mean(mesh.rgb))


def _first(mesh: Mesh, count: int) -> Mesh:
    return Mesh(vertices_W=mesh.vertices_W, faces=mesh.faces[:count], rgb=mesh.rgb)
