"""Marching cubes in four passes over the blocks: mark edges, count vertices, emit vertices, emit
triangles."""

import functools

import torch
from torch import Tensor

from gsfusion_nb.tsdf.block_pool import VOXELS_PER_BLOCK
from gsfusion_nb.tsdf.marching_cubes import triangle_table
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Mesh

from ..runtime.arguments import check_dtype, parts
from ..runtime.cuda.launch import device_of, launch

_BLOCK = 128
_EDGES = 3 * VOXELS_PER_BLOCK
"""Of a block: those that begin in its voxels."""
_WORDS = _EDGES // 32
"""Bits of the edges of a block, in words of 32."""


def extract_mesh(volume: TsdfVolume, *, min_weight: float = 1.0) -> Mesh:
    """See ``gsfusion_nb.tsdf.extract_mesh``. The host waits once, for the size of the mesh."""
    device = device_of("extract_mesh", volume.D)
    check_dtype("extract_mesh", torch.float32, volume=volume.D)
    B = volume.n_blocks
    coords = volume.block_coords
    field = {
        "D": volume.D,
        "W": volume.W,
        "neighbour": _neighbours(volume),
        "min_weight": min_weight,
    }
    table = _table(device)
    triangles = torch.zeros(B, dtype=torch.int32, device=device)
    words = torch.zeros(B * _WORDS, dtype=torch.int32, device=device)
    n_vertices = torch.empty_like(words)
    launch("extract_mesh", "marching_cubes:mark_edges", B, _BLOCK, field, table, triangles, words)
    blocks = parts(len(words), _BLOCK)
    launch(
        "extract_mesh",
        "marching_cubes:count_vertices",
        blocks,
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
        edges = {"words": words, "before": before}
        voxel_size_m = volume.config.voxel_size_m
        launch(
            "extract_mesh",
            "marching_cubes:emit_vertices",
            (B, _EDGES // _BLOCK),
            _BLOCK,
            field,
            edges,
            volume.rgb_planes,
            coords,
            voxel_size_m,
            vertices,
            rgb,
        )
        launch(
            "extract_mesh",
            "marching_cubes:emit_triangles",
            B,
            _BLOCK,
            field,
            table,
            edges,
            triangles,
            first,
            faces,
        )
    return Mesh(vertices_W=vertices, faces=faces, rgb=rgb)


def _neighbours(volume: TsdfVolume) -> Tensor:
    """Rows of each block and its seven upper neighbours, number 4 x + 2 y + z; -1 where absent.
    int32 [B, 8]"""
    steps = torch.tensor(
        [[n >> 2, n >> 1 & 1, n & 1] for n in range(8)], dtype=torch.int32, device=volume.device
    )
    around = (volume.block_coords[:, None] + steps).view(-1, 3)
    return volume.index.find(around).to(torch.int32)


@functools.cache
def _table(device: torch.device) -> dict[str, Tensor]:
    triangles, count = (numbers.to(device, torch.int8).contiguous() for numbers in triangle_table())
    return {"triangles": triangles, "count": count}
