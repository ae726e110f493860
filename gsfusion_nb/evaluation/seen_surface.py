"""What frames show of a surface: the part of a mesh that was seen, and its colours against those of
the pictures."""

import math
from collections.abc import Iterable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..geometry import project, se3
from ..large_maps.chunks import Chunks, chunks_of_points, rows_of_chunks, seen_chunks
from ..resources import MAP_MEMORY
from ..types import Frame, Mesh
from .image import psnr
from .metrics import NotComputed
from .triangles import FACES_AT_A_TIME, measure_faces

BEHIND_M = 0.05
"""How far behind the measured depth a point still counts as seen, metres."""
NEAR_M = 0.02
"""A view shows a vertex if its measured depth there differs by less than this, metres."""


def mesh_psnr(mesh: Mesh, frames: Iterable[Frame]) -> float | NotComputed:
    """PSNR between the vertices of a mesh and the pixels that show them, dB, mean of the views.

    A vertex is compared with the pixel that contains its projection, if the depth there is that of
    the vertex. What the triangles show between the vertices is not compared, nor what the mesh does
    not cover.

    Args:
        mesh: The mesh; its colours are clamped to 0..1 and rounded to 8 bits, as in ``mesh.ply``.
        frames: The views, with poses in the frame of the mesh; one pass.

    Returns:
        Decibels, or the reason why there are none. Views that show no vertex do not count.

    Differentiable: no.
    """
    scores = []
    chunks = chunks_of_points(mesh.vertices_W)
    for frame in frames:
        frame = frame.to(mesh.vertices_W.device)
        rows, z_m, at = _in_view(mesh.vertices_W, chunks, frame)
        depth_m = frame.depth_m[at]
        is_shown = (depth_m > 0) & ((depth_m - z_m).abs() < NEAR_M)
        if bool(is_shown.any()):
            scores.append(
                psnr(
                    mesh.rgb[rows[is_shown]][None],
                    frame.rgb[at][is_shown][None],
                )
            )
    if not scores:
        return NotComputed("no view shows a vertex of the mesh")
    return math.fsum(scores) / len(scores)


def seen_by(
    xyz_W: Float[Tensor, "N 3"],
    frames: Iterable[Frame],
) -> Bool[Tensor, " N"]:
    """Points that at least one frame shows: inside its image, and at most 5 cm behind the measured
    depth.

    A pixel without measured depth shows nothing. The frames are read one by one.

    Args:
        xyz_W: Points, metres. [N, 3]
        frames: The observations; one pass.

    Differentiable: no.
    """
    is_seen = torch.zeros(len(xyz_W), dtype=torch.bool, device=xyz_W.device)
    chunks = chunks_of_points(xyz_W)
    for frame in frames:
        if bool(is_seen.all()):
            break
        rows, z_m, at = _in_view(xyz_W, chunks, frame, but=is_seen)
        measured_m = frame.depth_m.to(xyz_W)[at]
        is_seen[rows[(measured_m > 0) & (z_m <= measured_m + BEHIND_M)]] = True
        MAP_MEMORY.give_back()
    return is_seen


def cull_unseen(mesh: Mesh, frames: Iterable[Frame]) -> Mesh:
    """The part of ``mesh`` that the frames show: faces of which a corner or the centroid is
    ``seen_by`` one of them.

    For meshes of small triangles; a wall of two triangles is kept completely if one of its corners
    is seen.
    """
    n = len(mesh.vertices_W)
    points = MAP_MEMORY.rows(
        n + len(mesh.faces),
        3,
        dtype=mesh.vertices_W.dtype,
        device=mesh.vertices_W.device,
    )
    points[:n] = mesh.vertices_W
    points[n:] = measure_faces(mesh, lambda corners: corners.mean(1), 3)
    is_seen = seen_by(points, frames)
    faces = _copy_of_rows(
        mesh.faces,
        is_seen[:n][mesh.faces.long()].any(1) | is_seen[n:],
    )
    is_used = torch.zeros(n, dtype=torch.bool, device=faces.device)
    is_used[faces.view(-1).long()] = True
    number = is_used.cumsum(0) - 1
    for part in faces.split(FACES_AT_A_TIME):
        part.copy_(number[part.long()])
    return Mesh(
        vertices_W=_copy_of_rows(mesh.vertices_W, is_used),
        faces=faces,
        rgb=_copy_of_rows(mesh.rgb, is_used),
    )


def _in_view(
    xyz_W: Float[Tensor, "N 3"],
    chunks: Chunks,
    frame: Frame,
    but: Bool[Tensor, " N"] | None = None,
) -> tuple[Int[Tensor, " M"], Float[Tensor, " M"], tuple[Tensor, Tensor]]:
    """Points inside the image of a frame, without those in ``but``, their depths, rows and columns
    of their pixels."""
    T_CW = se3.inverse(frame.T_WC.to(xyz_W))
    camera = frame.camera
    numbers = seen_chunks(chunks, camera, frame.T_WC, frame.depth_m)
    rows = rows_of_chunks(numbers, len(xyz_W)).to(xyz_W.device)
    rows = rows if but is None else rows[~but[rows]]
    xyz_C = se3.apply(T_CW, xyz_W[rows])
    in_front = (xyz_C[:, 2] > 1e-6).nonzero()[:, 0]
    uv = project(camera, xyz_C[in_front])
    is_inside = (
        (uv >= 0) & (uv < torch.tensor([camera.width, camera.height], device=uv.device))
    ).all(dim=1)
    column, row = uv[is_inside].long().unbind(1)
    return rows[in_front[is_inside]], xyz_C[in_front[is_inside], 2], (row, column)


def _copy_of_rows(rows: Tensor, which: Bool[Tensor, " N"]) -> Tensor:
    """A copy of the rows where ``which`` is true, in a file if the map is in files."""
    places = which.nonzero()[:, 0]
    copy = MAP_MEMORY.rows(
        len(places),
        *rows.shape[1:],
        dtype=rows.dtype,
        device=rows.device,
    )
    MAP_MEMORY.give_back()
    return torch.index_select(rows, 0, places, out=copy)
