"""Marching cubes in four passes over the blocks: mark edges, count vertices, emit vertices, emit triangles."""

import ctypes
import functools

import torch
from torch import Tensor

from gsfusion_nb.tsdf.triangle_table import triangle_table
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Mesh

from ..runtime.cuda.launch import check_dtype, device_of, launch, parts

_BLOCK = 128
_WORDS = 48
"""Bits of the 3 x 512 edges of a block, in words of 32."""


def extract_mesh(volume: TsdfVolume, *, min_weight: float = 1.0) -> Mesh:
    """See ``gsfusion_nb.tsdf.extract_mesh``. The host waits once, for the size of the mesh."""
    device = device_of("extract_mesh", volume=volume.D)
    check_dtype("extract_mesh", torch.float32, volume=volume.D)
    B, coords = volume.n_blocks, volume.block_coords
    neighbour = _neighbours(volume)
    table = _table(device)
    voxels = (volume.D, volume.W, neighbour, float(min_weight), *table)
    triangles = torch.zeros(B, dtype=torch.int32, device=device)
    words = torch.zeros(B * _WORDS, dtype=torch.int32, device=device)
    n_vertices = torch.empty_like(words)
    launch("extract_mesh", "marching_cubes:mark_edges", B, _BLOCK, *voxels, triangles, words)
    launch(
        "extract_mesh",
        "marching_cubes:count_vertices",
        parts(len(words), _BLOCK),
        _BLOCK,
        words,
        n_vertices,
        len(words),
    )
    before, first = (x.cumsum(0, dtype=torch.int32) - x for x in (n_vertices, triangles))
    V, F = torch.stack([n_vertices.sum(), triangles.sum()]).tolist()
    vertices, rgb = (torch.empty(V, 3, dtype=torch.float32, device=device) for _ in range(2))
    faces = torch.empty(F, 3, dtype=torch.int64, device=device)
    if F:
        edge = ctypes.c_double(volume.config.voxel_size_m)
        launch(
            "extract_mesh", "marching_cubes:emit_vertices", (B, 3 * 512 // _BLOCK), _BLOCK, volume.D,
            volume.rgb_planes, coords, neighbour, words, before, edge, vertices, rgb,
        )  # fmt: skip
        launch(
            "extract_mesh", "marching_cubes:emit_triangles", B, _BLOCK, *voxels, triangles, first, words, before, faces
        )
    return Mesh(vertices_W=vertices, faces=faces, rgb=rgb)


def _neighbours(volume: TsdfVolume) -> Tensor:
    """Rows of each block and its seven upper neighbours, number 4 x + 2 y + z; -1 where absent. int32 [B, 8]"""
    steps = torch.tensor([[n >> 2, n >> 1 & 1, n & 1] for n in range(8)], dtype=torch.int32, device=volume.device)
    around = (volume.block_coords[:, None] + steps).view(-1, 3)
    return volume.index.find(around).to(torch.int32)


@functools.cache
def _table(device: torch.device) -> tuple[Tensor, Tensor]:
    """Edges of the triangles of every case, and their number, one byte each."""
    table, count = triangle_table()
    return table.to(device, torch.int8).contiguous(), count.to(device, torch.int8)
