"""Colours of a mesh, compared with views that it was not made from."""

import math
from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import project, se3
from ..types import Frame, Mesh
from .image import psnr
from .not_computed import NotComputed

NEAR_M = 0.02
"""A view shows a vertex if its measured depth there differs by less than this, metres."""


def mesh_psnr(mesh: Mesh, frames: Iterable[Frame], *, near_m: float = NEAR_M) -> float | NotComputed:
    """PSNR between the vertices of a mesh and the pixels that show them, dB, mean of the views.

    A vertex is compared with the pixel that contains its projection, if the depth there is that of the vertex. What the
    triangles show between the vertices is not compared, nor what the mesh does not cover.

    Args:
        mesh: The mesh; its colours are clamped to 0..1 and rounded to 8 bits, as in ``mesh.ply``.
        frames: The views, with poses in the frame of the mesh; one pass.
        near_m: Largest difference between the depth of the vertex and of the pixel, metres.

    Returns:
        Decibels, or the reason why there are none. Views that show no vertex do not count.

    Differentiable: no.
    """
    scores = []
    for frame in frames:
        shown, pixels = _pairs(mesh, frame.to(mesh.vertices_W.device), near_m)
        if len(shown):
            scores.append(psnr(shown[None], pixels[None]))
    if not scores:
        return NotComputed("no view shows a vertex of the mesh")
    return math.fsum(scores) / len(scores)


def _pairs(mesh: Mesh, frame: Frame, near_m: float) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
    """Colours of the vertices that the frame shows, and of their pixels."""
    xyz_C = se3.apply(se3.inverse(frame.T_WC.to(mesh.vertices_W)), mesh.vertices_W)
    rows = (xyz_C[:, 2] > 1e-6).nonzero()[:, 0]
    uv = project(frame.camera, xyz_C[rows])
    size = torch.tensor([frame.camera.width, frame.camera.height], device=uv.device)
    inside = ((uv >= 0) & (uv < size)).all(dim=1)
    rows, (column, row) = rows[inside], uv[inside].long().unbind(1)
    depth_m = frame.depth_m[row, column]
    seen = (depth_m > 0) & ((depth_m - xyz_C[rows, 2]).abs() < near_m)
    return mesh.rgb[rows[seen]], frame.rgb[row[seen], column[seen]]
