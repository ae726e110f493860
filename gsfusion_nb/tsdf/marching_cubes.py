"""The surface of the volume as a triangle mesh: marching cubes straight from the sparse blocks."""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..backends import op, piece
from ..checks import check_number
from ..constants import VOXELS_PER_BLOCK
from ..types import Mesh
from .triangle_table import EDGES, triangle_table
from .trilinear import CORNERS
from .volume import VOXELS, TsdfVolume, check_volume

BLOCKS_AT_A_TIME = 256
"""Limits the memory for intermediate results, independent of the size of the map."""


def check_mesh(volume: Any, *, min_weight: float = 1.0) -> None:
    """Raise ``ValueError`` for arguments that ``extract_mesh`` refuses."""
    check_volume(volume)
    check_number("min_weight", min_weight)


@op("marching_cubes", check_mesh)
def extract_mesh(volume: TsdfVolume, *, min_weight: float = 1.0) -> Mesh:
    """Marching cubes over the blocks (Lorensen & Cline 1987), with vertices on the zero crossing of D.

    A cube spans eight voxel centres and is meshed only when all eight were observed at least ``min_weight`` times, so
    the end of the truncation band creates no false surface. Every cut edge has one vertex, shared by all its triangles.

    Args:
        volume: The map.
        min_weight: Smallest observation count of a usable voxel.

    Returns:
        Vertices in the world frame (metres), their colours interpolated between the two voxels, and faces,
        counter-clockwise seen from the free side.

    Differentiable: no.
    """
    rows = torch.arange(volume.n_blocks, device=volume.device)
    triangles = torch.cat([_triangles(volume, part, min_weight) for part in rows.split(BLOCKS_AT_A_TIME)])
    edges, faces = triangles.unique(return_inverse=True)
    vertices_W, rgb = _vertices(volume, edges)
    return Mesh(vertices_W=vertices_W, faces=faces, rgb=rgb)


def _triangles(volume: TsdfVolume, rows: Int[Tensor, " B"], min_weight: float) -> Int[Tensor, "F 3"]:
    """The three cut edges of every triangle of the cubes whose lowest corners are the voxels of some blocks.

    The number of an edge is 3 x (position of its lower voxel in the flattened pool) + axis.
    """
    corner = _cube_corners(volume, rows)
    D, weight = volume.D.view(-1)[corner], volume.W.view(-1)[corner]
    usable = ((corner >= 0) & (weight > 0) & (weight >= min_weight)).all(1)
    bit = 2 ** torch.arange(8, device=volume.device)
    case = ((D < 0) * bit).sum(1) * usable  # a cube of case 0 has no triangles

    table, count = (t.to(volume.device) for t in triangle_table())
    cube, nth = (torch.arange(table.shape[1], device=volume.device) < count[case][:, None]).nonzero().unbind(1)
    axis, lower = torch.tensor(EDGES, device=volume.device)[table[case[cube], nth]].unbind(-1)
    return 3 * corner[cube[:, None], lower] + axis


def _cube_corners(volume: TsdfVolume, rows: Int[Tensor, " B"]) -> Int[Tensor, "C 8"]:
    """Position in the flattened pool of the eight corners of each cube, -1 where not allocated.

    They lie in the block of the lowest corner or in one of its seven upper neighbours.
    """
    device = volume.device
    coords = volume.block_coords[rows, None] + CORNERS.to(device)
    neighbour = volume.index.find(coords.view(-1, 3)).view(-1, 8)
    xyz = (VOXELS[:, None] + CORNERS).to(device)  # 0..8, in voxels from the corner of the block  [512, 8, 3]
    which, number = (xyz >> 3) @ xyz.new_tensor([1, 2, 4]), (xyz & 7) @ xyz.new_tensor([64, 8, 1])
    row = neighbour[:, which]
    return torch.where(row < 0, -1, row * VOXELS_PER_BLOCK + number).view(-1, 8)


def _vertices(volume: TsdfVolume, edges: Int[Tensor, " V"]) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "V 3"]]:
    """Positions and colours of the points on edges where D, linear between the two voxel centres, is zero."""
    first, axis = edges // 3, edges % 3
    along = torch.eye(3, dtype=torch.int64, device=edges.device)[axis]
    ijk = volume.voxel_at(first)
    second = volume.find_voxels(ijk + along)
    D0, D1 = volume.D.view(-1)[first], volume.D.view(-1)[second]
    t = (D0 / (D0 - D1))[:, None]
    centre = ijk.double() + 0.5
    xyz_W = zero_crossing(centre, centre + along, D0, D1) * volume.config.voxel_size_m
    return xyz_W.to(D0.dtype), torch.lerp(volume.voxel_rgb(first), volume.voxel_rgb(second), t)


@piece
def zero_crossing(
    p0: Float[Tensor, "V 3"], p1: Float[Tensor, "V 3"], D0: Float[Tensor, " V"], D1: Float[Tensor, " V"]
) -> Float[Tensor, "V 3"]:
    """The point of each edge where D, linear between its ends p0 and p1 of different sign, is zero.

    Source: Lorensen & Cline 1987, section 4.
    """
    t = (D0 / (D0 - D1))[:, None].to(p0)
    return p0 + t * (p1 - p0)
