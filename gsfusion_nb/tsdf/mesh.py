"""The surface of the volume as a triangle mesh: marching cubes straight from the sparse blocks."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import op
from ..constants import VOXELS_PER_BLOCK
from ..types import Mesh
from .marching_cubes import EDGES, triangle_table
from .volume import TsdfVolume

CHUNK_BLOCKS = 256
"""Blocks meshed at a time: bounds the temporaries to some tens of megabytes whatever the size of the map."""


@op("marching_cubes")
def extract_mesh(volume: TsdfVolume, *, min_weight: float = 1.0) -> Mesh:
    """Marching cubes over the blocks (Lorensen & Cline 1987), with vertices on the zero crossing of D.

    A cube spans eight voxel centres and is meshed only when all eight were observed at least ``min_weight`` times, so
    the end of the truncation band makes no false surface. Every cut edge has one vertex, shared by all its triangles.

    Args:
        volume: The map.
        min_weight: Smallest observation count of a usable voxel.

    Returns:
        Vertices in the world frame (metres), their colours interpolated between the two voxels, and faces,
        counter-clockwise seen from the free side.

    Differentiable: no.
    """
    keys, points, colours, corners = [], [], [], []
    for start in range(0, volume.n_blocks, CHUNK_BLOCKS):
        cells = _gather(volume, start, min(start + CHUNK_BLOCKS, volume.n_blocks), min_weight)
        key, xyz_W, rgb = _cut_edges(volume, cells)
        keys.append(key)
        points.append(xyz_W)
        colours.append(rgb)
        corners.append(_triangles(cells))
    if not keys:
        zero = torch.zeros(0, 3, device=volume.device)
        return Mesh(vertices_W=zero, faces=zero.to(torch.int64), rgb=zero)
    # Chunks come in row order and edges in order within a chunk, so the keys are sorted.
    faces = torch.searchsorted(torch.cat(keys), torch.cat(corners))
    vertices_W, rgb = torch.cat(points), torch.cat(colours)
    used = torch.zeros(vertices_W.shape[0], dtype=torch.bool, device=volume.device)
    used[faces.view(-1)] = True
    renumbered = used.cumsum(0) - 1
    return Mesh(vertices_W=vertices_W[used], faces=renumbered[faces], rgb=rgb[used])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Cells:
    """Blocks with one more layer of voxels on the upper sides, taken from their neighbours."""

    start: int
    """Row of the first block."""
    D: Float[Tensor, "B 9 9 9"]
    seen: Bool[Tensor, "B 9 9 9"]
    """Observed often enough."""
    neighbour: Int[Tensor, "B 8"]
    """Rows of the block itself and its seven upper neighbours (4 x + 2 y + z), -1 where absent."""


def _gather(volume: TsdfVolume, start: int, stop: int, min_weight: float) -> _Cells:
    device = volume.device
    steps = torch.tensor([[n >> 2, n >> 1 & 1, n & 1] for n in range(8)], dtype=torch.int32, device=device)
    coords = volume.block_coords[start:stop, None] + steps
    neighbour = volume.index.find(coords.view(-1, 3)).view(-1, 8)
    b = stop - start
    D = torch.ones(b, 9, 9, 9, device=device)
    seen = torch.zeros(b, 9, 9, 9, dtype=torch.bool, device=device)
    body, layer = (slice(0, 8), slice(0, 8)), (slice(8, 9), slice(0, 1))
    for n in range(8):
        axes = [layer if bit else body for bit in (n >> 2, n >> 1 & 1, n & 1)]
        to, source = (slice(None), *(a[0] for a in axes)), (slice(None), *(a[1] for a in axes))
        rows = neighbour[:, n].clamp_min(0)
        D[to] = volume.D.view(-1, 8, 8, 8)[source].index_select(0, rows)
        present = (neighbour[:, n] >= 0)[:, None, None, None]
        weight = volume.W.view(-1, 8, 8, 8)[source].index_select(0, rows)
        seen[to] = (weight >= min_weight) & (weight > 0) & present
    return _Cells(start=start, D=D, seen=seen, neighbour=neighbour)


def _cut_edges(volume: TsdfVolume, cells: _Cells) -> tuple[Tensor, Tensor, Tensor]:
    """Key, position and colour of the vertex on every voxel edge with a sign change between two observed ends.

    The key of an edge is 3 x (position of its lower voxel in the flattened pool) + axis.
    """
    negative = cells.D < 0
    low = (slice(None), slice(0, 8), slice(0, 8), slice(0, 8))
    cut = []
    for axis in range(3):
        high = (*low[: axis + 1], slice(1, 9), *low[axis + 2 :])
        cut.append((negative[low] != negative[high]) & cells.seen[low] & cells.seen[high])
    edge = torch.stack(cut, dim=-1).view(-1).nonzero()[:, 0]
    voxel, axis = edge // 3, edge % 3
    block, number = voxel // VOXELS_PER_BLOCK, voxel % VOXELS_PER_BLOCK
    xyz = torch.stack([number >> 6, number >> 3 & 7, number & 7], dim=1)
    along = torch.eye(3, dtype=torch.int64, device=edge.device)[axis]
    D0, D1 = (cells.D[block, p[:, 0], p[:, 1], p[:, 2]] for p in (xyz, xyz + along))
    t = D0 / (D0 - D1)
    first, second = (_pool_position(cells, block, p) for p in (xyz, xyz + along))
    rgb = torch.lerp(volume.voxel_rgb(first), volume.voxel_rgb(second), t[:, None])
    coords = volume.block_coords[cells.start + block].double() * 8 + xyz + 0.5 + along * t[:, None].double()
    return edge + cells.start * VOXELS_PER_BLOCK * 3, (coords * volume.config.voxel_size_m).to(torch.float32), rgb


def _triangles(cells: _Cells) -> Int[Tensor, "F 3"]:
    """Keys of the three edges of every triangle."""
    case = _corner_bits((cells.D < 0).to(torch.uint8))
    whole = cells.seen
    for axis in (1, 2, 3):
        whole = whole.narrow(axis, 0, 8) & whole.narrow(axis, 1, 8)
    cube = (whole & (case != 0) & (case != 255)).view(-1).nonzero()[:, 0]
    table, count = (t.to(cube.device) for t in triangle_table())
    case_of = case.view(-1)[cube].to(torch.int64)
    n = count[case_of]
    cube = cube.repeat_interleave(n)
    nth = torch.arange(cube.shape[0], device=cube.device) - (n.cumsum(0) - n).repeat_interleave(n)
    edges = table[case_of.repeat_interleave(n), nth]
    axis = torch.tensor([a for a, _ in EDGES], device=cube.device)[edges]
    corner = torch.tensor([[c & 1, c >> 1 & 1, c >> 2] for _, c in EDGES], device=cube.device)[edges]
    block, number = cube // VOXELS_PER_BLOCK, cube % VOXELS_PER_BLOCK
    xyz = torch.stack([number >> 6, number >> 3 & 7, number & 7], dim=1)
    owner = (xyz[:, None] + corner).view(-1, 3)
    return _pool_position(cells, block.repeat_interleave(3), owner).view(-1, 3) * 3 + axis


def _corner_bits(negative: Tensor) -> Tensor:
    """Case of every cube: bit x + 2 y + 4 z is set where that corner is negative. One axis at a time."""
    bits = negative
    for axis, shift in ((1, 1), (2, 2), (3, 4)):
        bits = bits.narrow(axis, 0, 8) | (bits.narrow(axis, 1, 8) << shift)
    return bits


def _pool_position(cells: _Cells, block: Int[Tensor, " N"], xyz: Int[Tensor, "N 3"]) -> Int[Tensor, " N"]:
    """Position in the flattened pool of the voxel at ``xyz`` (0..8) of an extended block."""
    x, y, z = xyz.unbind(1)
    row = cells.neighbour.view(-1)[block * 8 + (x >> 3) * 4 + (y >> 3) * 2 + (z >> 3)]
    return row * VOXELS_PER_BLOCK + (x & 7) * 64 + (y & 7) * 8 + (z & 7)
