"""Marching cubes in three passes over the blocks; 64 voxels at a time are one word while only signs matter.

First the signs and the observed voxels as bits, then which cubes and which of their edges make a surface (both in
``topology``), then the vertices and triangles. Order and numbering are the reference's.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

import numpy as np
import torch
from numba import int64, njit, prange, uint64

from gsfusion_nb.tsdf.block_pool import BLOCK_VOXELS, VOXELS_PER_BLOCK
from gsfusion_nb.tsdf.marching_cubes import EDGES, triangle_table
from gsfusion_nb.tsdf.marching_cubes import extract_mesh as reference
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Mesh

from ..runtime.numba.launch import launching
from ..runtime.numba.scalars import lowest, popcount
from .layout import Grid, MeshArrays, Tables, Topology, Voxels, X, Y, Z
from .topology import NONE, case_of, corner_words, find_topology, sign_words

f32 = np.float32
_ONE, _HALF = f32(1.0), f32(0.5)
_EDGES = np.array(EDGES, np.int64)
_STEP_X, _STEP_Y, _STEP_Z = BLOCK_VOXELS * BLOCK_VOXELS, BLOCK_VOXELS, 1
"""From a voxel to the next one along each axis, in the order in which a block is stored."""


def extract_mesh(volume: TsdfVolume, *, min_weight: float = 1.0) -> Mesh:
    """See ``gsfusion_nb.tsdf.extract_mesh``."""
    if volume.D.dtype != torch.float32 or volume.device.type != "cpu" or not volume.n_blocks:
        return reference.reference(volume, min_weight=min_weight)
    coords = volume.block_coords
    upper, lower = np.empty((3, len(coords)), np.int64), np.full((3, len(coords)), -1, np.int64)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.int32)
        step[axis] = 1
        upper[axis] = volume.index.find(coords + step).numpy()
        known = np.flatnonzero(upper[axis] >= 0)
        lower[axis, upper[axis, known]] = known
    voxels = Voxels(*(t.view(-1).numpy() for t in (volume.D, volume.W, volume.rgb_planes)))
    triangles, count = (t.numpy() for t in triangle_table())
    tables = Tables(triangles=triangles, count=count, edges=_EDGES)
    with launching():
        negative, seen = np.empty((len(coords), 8), np.uint64), np.empty((len(coords), 8), np.uint64)
        sign_words(voxels, f32(min_weight), negative, seen)
        topology = Topology(*find_topology(negative, seen, upper, lower, count))
        n_vertices, n_triangles = int(topology.first_vertex[-1]), int(topology.first_triangle[-1])
        vertices, rgb = torch.empty(n_vertices, 3), torch.empty(n_vertices, 3)
        faces = torch.empty(n_triangles, 3, dtype=torch.int64)
        mesh = MeshArrays(vertices=vertices.numpy(), rgb=rgb.numpy(), faces=faces.numpy())
        grid = Grid(coords=coords.numpy(), voxel_size_m=float(volume.config.voxel_size_m), upper=upper)
        _emit(voxels, topology, tables, grid, mesh)
    return Mesh(vertices_W=vertices, faces=faces, rgb=rgb)


@njit(cache=True, error_model="numpy")
def _vertex(words, starts, b, x, bit, axis):
    """Number of the vertex on an edge: those of earlier slabs, earlier voxels of this slab, and earlier axes."""
    below = (uint64(1) << bit) - uint64(1)
    n = starts[8 * b + x]
    for a in range(3):
        w = words[a, b, x]
        n += popcount(w & below)
        if a < axis:
            n += int64(w >> bit & uint64(1))
    return n


@njit(parallel=True, cache=True, error_model="numpy")
def _emit(voxels, topology, tables, grid, mesh):
    """Write the vertices of every block, and its triangles."""
    D, C = voxels.D, voxels.rgb
    words, active, starts = topology.words, topology.active, topology.first_vertex
    first_triangle = topology.first_triangle
    table, count, edges = tables.triangles, tables.count, tables.edges
    coords, voxel_size, upper = grid.coords, grid.voxel_size_m, grid.upper
    vertices, rgb, faces = mesh.vertices, mesh.rgb, mesh.faces
    B = active.shape[0]
    for task in prange(B):
        b = int64(task)
        number = np.empty(12, np.int64)
        out = first_triangle[b]
        for x in range(8):
            _vertices_of_slab(D, C, words, starts, upper, (b, x), coords[b], voxel_size, vertices, rgb)
            cubes = active[b, x]
            if cubes == NONE:
                continue
            corners = corner_words(words, b, x, upper)
            while cubes != NONE:
                bit = lowest(cubes)
                cubes &= cubes - uint64(1)
                case = case_of(corners, bit)
                y, z = int64(bit >> uint64(3)), int64(bit & uint64(7))
                for e in range(12):
                    axis, corner = edges[e]
                    if (case >> corner & 1) == (case >> (corner | 1 << axis) & 1):
                        continue
                    row, ox, oy, oz = b, x + (corner & 1), y + (corner >> 1 & 1), z + (corner >> 2)
                    if ox > 7:
                        row, ox = upper[X, row], 0
                    if oy > 7:
                        row, oy = upper[Y, row], 0
                    if oz > 7:
                        row, oz = upper[Z, row], 0
                    number[e] = _vertex(words, starts, row, ox, uint64(8 * oy + oz), axis)
                for t in range(count[case]):
                    for k in range(3):
                        faces[out, k] = number[table[case, t, k]]
                    out += 1


@njit(cache=True, error_model="numpy")
def _vertices_of_slab(D, C, words, starts, upper, slab, corner, voxel_size, vertices, rgb):
    """Write the vertices on the edges that begin in a slab: at the zero of D along the edge, with the colour there."""
    b, x = slab
    out = starts[8 * b + x]
    voxels = words[X, b, x] | words[Y, b, x] | words[Z, b, x]
    while voxels != NONE:
        bit = lowest(voxels)
        voxels &= voxels - uint64(1)
        y, z = int64(bit >> uint64(3)), int64(bit & uint64(7))
        n = x * _STEP_X + y * _STEP_Y + z * _STEP_Z
        D0 = D[b * VOXELS_PER_BLOCK + n]
        for axis in range(3):
            if (words[axis, b, x] >> bit & uint64(1)) == NONE:
                continue
            at = x if axis == X else (y if axis == Y else z)
            step = _STEP_X if axis == X else (_STEP_Y if axis == Y else _STEP_Z)
            row, m = (b, n + step) if at < 7 else (upper[axis, b], n - 7 * step)
            t = D0 / (D0 - D[row * VOXELS_PER_BLOCK + m])
            vertices[out, 0] = (corner[0] * 8 + x + 0.5 + (np.float64(t) if axis == X else 0.0)) * voxel_size
            vertices[out, 1] = (corner[1] * 8 + y + 0.5 + (np.float64(t) if axis == Y else 0.0)) * voxel_size
            vertices[out, 2] = (corner[2] * 8 + z + 0.5 + (np.float64(t) if axis == Z else 0.0)) * voxel_size
            for c in range(3):
                first, second = C[(b * 3 + c) * VOXELS_PER_BLOCK + n], C[(row * 3 + c) * VOXELS_PER_BLOCK + m]
                towards = second - first
                rgb[out, c] = first + t * towards if t < _HALF else second - towards * (_ONE - t)
            out += 1
